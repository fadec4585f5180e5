#include "real.h"

#include <dlfcn.h>

#include <cstring>

extern "C" int Py_IsInitialized() __attribute__((weak));

namespace rsltrace {

// Not by dlsym: in vain, that asks the heap for the path of this library.
bool has_python() { return Py_IsInitialized != nullptr; }

void *real(const char *name) {
  // Without a version dlsym finds the condition variables of glibc 2.2, which are another type.
  // The clock's wait is newer.
  if (std::strncmp(name, "pthread_cond_", 13) == 0 && std::strcmp(name, "pthread_cond_clockwait") != 0)
    if (void *found = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2")) return found;
  return dlsym(RTLD_NEXT, name);
}

}  // namespace rsltrace
