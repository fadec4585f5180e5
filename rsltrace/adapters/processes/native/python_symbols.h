// What stands in for symbols of Python (python_symbols/symbols.cpp).
#pragma once

// A libpython that is loaded after the stand-ins refers to them: as its code (`caller`) asks for its
// variables, which it does before it uses any object, they get its values.
extern "C" __attribute__((visibility("default"))) void rsltrace_start_python(const void *caller);
