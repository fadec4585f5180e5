// The functions of libc that ours stand before.
#pragma once

namespace rsltrace {

// The next definition of `name` after this library's, or null if this libc has none.
void *real(const char *name);
// Whether the program has a Python.
bool has_python();

// Looked up when the library is loaded, or by who calls it before that. Not later: a thread that
// looks it up would wait for dlopen, whose constructors may wait for that thread.
template <typename Name>
struct Real {
  static void *found;
};
template <typename Name>
void *Real<Name>::found = real(Name::text());

}  // namespace rsltrace

#define REAL(name)                                                       \
  ([] {                                                                  \
    struct Name {                                                        \
      static const char *text() { return #name; }                        \
    };                                                                   \
    void *&found = ::rsltrace::Real<Name>::found;                        \
    if (found == nullptr) found = ::rsltrace::real(Name::text());        \
    return reinterpret_cast<decltype(&::name)>(found);                   \
  }())
