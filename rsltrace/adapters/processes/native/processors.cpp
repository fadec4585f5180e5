// The machine has four processors, whatever it has.
#include <sched.h>
#include <sys/sysinfo.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>

#include "real.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

constexpr int PROCESSORS = 4;

int affinity(size_t size, cpu_set_t *set) {
  if (size * 8 < PROCESSORS) return EINVAL;
  std::memset(set, 0, size);
  for (int i = 0; i < PROCESSORS; ++i) CPU_SET_S(i, size, set);
  return 0;
}

}  // namespace

RSLTRACE_EXPORT long sysconf(int name) noexcept {
  const bool asks = name == _SC_NPROCESSORS_ONLN || name == _SC_NPROCESSORS_CONF;
  return asks && linked() ? PROCESSORS : REAL(sysconf)(name);
}

RSLTRACE_EXPORT int get_nprocs() noexcept { return linked() ? PROCESSORS : REAL(get_nprocs)(); }
RSLTRACE_EXPORT int get_nprocs_conf() noexcept { return linked() ? PROCESSORS : REAL(get_nprocs_conf)(); }
RSLTRACE_EXPORT int sched_getcpu() noexcept { return linked() ? 0 : REAL(sched_getcpu)(); }

RSLTRACE_EXPORT int getcpu(unsigned *cpu, unsigned *node) noexcept {
  if (!linked()) return REAL(getcpu)(cpu, node);
  if (cpu != nullptr) *cpu = 0;
  if (node != nullptr) *node = 0;
  return 0;
}

RSLTRACE_EXPORT int sched_getaffinity(pid_t pid, size_t size, cpu_set_t *set) noexcept {
  if (!linked()) return REAL(sched_getaffinity)(pid, size, set);
  errno = affinity(size, set);
  return errno == 0 ? 0 : -1;
}

RSLTRACE_EXPORT int pthread_getaffinity_np(pthread_t thread, size_t size, cpu_set_t *set) noexcept {
  return linked() ? affinity(size, set) : REAL(pthread_getaffinity_np)(thread, size, set);
}

// Which processor a thread is on changes nothing in a simulation.
RSLTRACE_EXPORT int sched_setaffinity(pid_t pid, size_t size, const cpu_set_t *set) noexcept {
  return linked() ? 0 : REAL(sched_setaffinity)(pid, size, set);
}

RSLTRACE_EXPORT int pthread_setaffinity_np(pthread_t thread, size_t size, const cpu_set_t *set) noexcept {
  return linked() ? 0 : REAL(pthread_setaffinity_np)(thread, size, set);
}
