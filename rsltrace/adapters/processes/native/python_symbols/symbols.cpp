// What libraries of ROS want from Python as they are loaded, for programs that have no Python: the
// generators of Python messages, which librcl draws in. The preloaded library needs this one, so
// that it comes after Python, which has them, in programs linked with Python.
#include <dlfcn.h>
#include <link.h>

#include <cstring>

#include "../python_symbols.h"

extern "C" {
__attribute__((visibility("default"))) void *PyExc_RuntimeError[8] = {};
__attribute__((visibility("default"))) void *_Py_TrueStruct[8] = {};
}

namespace {

void take_over(void *python, const char *name, void **ours) {
  void *const theirs = dlsym(python, name);
  Dl_info info;
  ElfW(Sym) *symbol = nullptr;
  if (theirs == nullptr || theirs == ours) return;
  dladdr1(theirs, &info, reinterpret_cast<void **>(&symbol), RTLD_DL_SYMENT);
  if (symbol != nullptr && symbol->st_size <= sizeof PyExc_RuntimeError) std::memcpy(ours, theirs, symbol->st_size);
}

}  // namespace

void rsltrace_start_python(const void *caller) {
  static bool is_done = false;
  Dl_info info;
  if (is_done || dladdr(caller, &info) == 0 || std::strstr(info.dli_fname, "/libpython") == nullptr) return;
  is_done = true;
  void *const python = dlopen(info.dli_fname, RTLD_LAZY | RTLD_NOLOAD);
  if (python == nullptr) return;
  take_over(python, "PyExc_RuntimeError", PyExc_RuntimeError);
  take_over(python, "_Py_TrueStruct", _Py_TrueStruct);
  dlclose(python);
}
