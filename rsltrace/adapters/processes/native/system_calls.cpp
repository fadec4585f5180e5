// Calls of the kernel by their numbers, past the functions of libc: the same as by those.
#include <fcntl.h>
#include <sched.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/times.h>
#include <time.h>
#include <unistd.h>

#include <cstdarg>

#include "real.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

template <typename Pointer>
Pointer as(long argument) {
  return reinterpret_cast<Pointer>(argument);
}

long told(int failure) {
  if (failure == 0) return 0;
  errno = failure;
  return -1;
}

// How many bytes of the set were written.
long affinity(const long *a) {
  const auto size = static_cast<std::size_t>(a[1]);
  const int result = sched_getaffinity(static_cast<pid_t>(a[0]), size, as<cpu_set_t *>(a[2]));
  return result != 0 ? -1 : static_cast<long>(size < sizeof(cpu_set_t) ? size : sizeof(cpu_set_t));
}

}  // namespace

RSLTRACE_EXPORT long syscall(long number, ...) noexcept {
  va_list rest;
  va_start(rest, number);
  long a[6];
  for (long &argument : a) argument = va_arg(rest, long);
  va_end(rest);
  Thread *thread = nullptr;
  switch (number) {
    case SYS_futex:
    case SYS_getrandom:
    case SYS_clock_gettime:
    case SYS_clock_nanosleep:
    case SYS_nanosleep:
    case SYS_sched_yield:
    case SYS_sched_getaffinity:
    case SYS_getcpu:
    case SYS_getrusage:
    case SYS_gettimeofday:
    case SYS_openat:
#ifdef SYS_time
    case SYS_open:
    case SYS_time:
#endif
    case SYS_times: thread = me(); break;
    default: break;
  }
  if (thread != nullptr) switch (number) {
      case SYS_futex: return do_futex(*thread, a);
      case SYS_getrandom:
        return getrandom(as<void *>(a[0]), static_cast<std::size_t>(a[1]), static_cast<unsigned>(a[2]));
      case SYS_clock_gettime: return clock_gettime(static_cast<clockid_t>(a[0]), as<timespec *>(a[1]));
      case SYS_clock_nanosleep:
        return told(clock_nanosleep(static_cast<clockid_t>(a[0]), static_cast<int>(a[1]), as<const timespec *>(a[2]),
                                    as<timespec *>(a[3])));
      case SYS_nanosleep: return nanosleep(as<const timespec *>(a[0]), as<timespec *>(a[1]));
      case SYS_sched_yield: yield(*thread); return 0;
      case SYS_sched_getaffinity: return affinity(a);
      case SYS_getcpu: return getcpu(as<unsigned *>(a[0]), as<unsigned *>(a[1]));
      case SYS_getrusage: return getrusage(static_cast<__rusage_who_t>(a[0]), as<rusage *>(a[1]));
      case SYS_gettimeofday: return gettimeofday(as<timeval *>(a[0]), as<void *>(a[1]));
      case SYS_openat: return openat(static_cast<int>(a[0]), as<const char *>(a[1]), static_cast<int>(a[2]),
                                     static_cast<mode_t>(a[3]));
#ifdef SYS_time  // and other calls that newer machines do not have
      case SYS_open: return open(as<const char *>(a[0]), static_cast<int>(a[1]), static_cast<mode_t>(a[2]));
      case SYS_time: return time(as<time_t *>(a[0]));
#endif
      case SYS_times: return times(as<tms *>(a[0]));
      default: break;
    }
  return REAL(syscall)(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}
