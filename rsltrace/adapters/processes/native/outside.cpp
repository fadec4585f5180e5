// Threads that block outside of the simulation: in calls that are known to (waiting for a child
// process), and in others, which a service thread finds. It also idles for the process if the
// thread that ran last went outside or ended.
#include <fcntl.h>
#include <linux/futex.h>
#include <linux/membarrier.h>
#include <signal.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <cstring>
#include <set>

#include "calls.h"
#include "real.h"
#include "scheduler.h"
#include "threads.h"

namespace rsltrace {
namespace {

constexpr long LOOK_EVERY_NS = 250'000'000;

// What a thread does in the kernel, empty if it does not sleep in a call: with how often it has
// slept so far, so that two equal ones mean that it did not run in between. Nothing of this comes
// from the heap: how often the service thread looks depends on real time, and where the program's
// memory lies must not.
struct Sleep {
  char call[256] = "";
  char switches[128] = "";
  bool operator==(const Sleep &other) const {
    return std::strcmp(call, other.call) == 0 && std::strcmp(switches, other.switches) == 0;
  }
};

void read_of(const Thread &thread, const char *name, char *text, std::size_t size) {
  char path[64];
  std::snprintf(path, sizeof path, "/proc/self/task/%d/%s", thread.tid, name);
  const int file = static_cast<int>(REAL(syscall)(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC));
  const ssize_t length = file < 0 ? 0 : REAL(read)(file, text, size - 1);
  text[length < 0 ? 0 : length] = '\0';
  if (file >= 0) REAL(syscall)(SYS_close, file);
}

Sleep asleep(const Thread &thread) {
  Sleep sleep;
  read_of(thread, "syscall", sleep.call, sizeof sleep.call);
  const char first = sleep.call[0];
  if (first == '\0' || first == 'r' || first == '-' || prints(sleep.call)) return {};
  char status[8192];
  read_of(thread, "status", status, sizeof status);
  const char *switches = std::strstr(status, "voluntary_ctxt_switches");
  if (std::strstr(status, "State:\tS") == nullptr || switches == nullptr) return {};
  std::snprintf(sleep.switches, sizeof sleep.switches, "%s", switches);
  return sleep;
}

long membarrier(int command) { return REAL(syscall)(SYS_membarrier, command, 0, 0); }

struct Seen {
  Thread *thread = nullptr;
  std::uint64_t turn = 0;
  Sleep sleep;
};

// Take the baton from a thread that sleeps in the kernel for two looks. It may return at any moment:
// it is marked first, and only if it still sleeps when every processor has seen that is it left
// behind. A mark it finds when it comes back it takes away itself (enter()).
bool take_from(Thread &thread, const Sleep &sleep) {
  if (!thread.open.load()) return false;
  thread.seized.store(1);
  thread.open.store(false);
  if (membarrier(MEMBARRIER_CMD_PRIVATE_EXPEDITED) != 0 || !(asleep(thread) == sleep)) return false;
  std::uint8_t marked = 1;
  if (!thread.seized.compare_exchange_strong(marked, 2)) return false;
  seize(thread, "a call that blocks");
  tell_outside(thread, name_of_call(sleep.call));
  return true;
}

bool look_at_holder(Seen &seen) {
  Thread *thread = holder();
  const std::uint64_t turn = turns();
  const Sleep sleep = thread == nullptr || !thread->open.load() ? Sleep{} : asleep(*thread);
  if (sleep.call[0] != '\0' && seen.thread == thread && seen.turn == turn && seen.sleep == sleep)
    return take_from(*thread, sleep);
  seen = {thread, turn, sleep};
  return false;
}

void *serve(void *) {
  self = &service;
  service.tid = static_cast<pid_t>(REAL(syscall)(SYS_gettid));
  const bool seizes = membarrier(MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED) == 0;
  Seen seen;
  for (;;) {
    timespec pause{0, LOOK_EVERY_NS};
    if (service.gate.load() == 0)
      REAL(syscall)(SYS_futex, &service.gate, FUTEX_WAIT_PRIVATE, 0, &pause, nullptr, 0);
    if (service.gate.load() != 0) {
      stand(service);
      turn_over(service);
    } else if (seizes && look_at_holder(seen)) {
      turn_over(service);
    }
  }
  return nullptr;
}

}  // namespace

void start_service() {
  if (service.service) return;
  service.service = true;
  remember_streams();
  sigset_t everything, before;
  sigfillset(&everything);
  pthread_sigmask(SIG_SETMASK, &everything, &before);
  pthread_t handle;
  if (REAL(pthread_create)(&handle, nullptr, serve, nullptr) == 0) REAL(pthread_detach)(handle);
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
}

namespace {

bool is_new(const std::string &what) {
  static auto *told = new std::set<std::string>;
  return told->insert(what).second;
}

void tell_real_timer(const char *call) {
  if (me() != nullptr && is_new(call))
    report(std::string(call) + " counts real time: when its signal comes is not determined");
}

}  // namespace

void tell_outside(Thread &thread, const std::string &what) {
  if (!is_new(what)) return;
  report("thread " + std::to_string(thread.number) + " blocks outside of the simulation, in " + what +
         ": what comes from there, and when, is not determined");
}

Outside::Outside(Thread &thread, const char *what) : thread_(thread) {
  thread_.open.store(false);
  tell_outside(thread, what);
  leave(thread_, what);
}

Outside::~Outside() {
  const int error = errno;
  come_back(thread_);
  thread_.open.store(true);
  errno = error;
}

Asking::Asking() : open_(self != nullptr && self->open.exchange(false)) {}

Asking::~Asking() {
  if (open_) self->open.store(true);
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT pid_t waitpid(pid_t pid, int *status, int options) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(waitpid)(pid, status, options);
  const pid_t ended = REAL(waitpid)(pid, status, options | WNOHANG);
  if (ended != 0) return ended;
  if ((options & WNOHANG) != 0) {
    look(*thread, 100);
    return 0;
  }
  Outside outside(*thread, "waitpid");
  return REAL(waitpid)(pid, status, options);
}

RSLTRACE_EXPORT pid_t wait(int *status) { return waitpid(-1, status, 0); }

RSLTRACE_EXPORT pid_t wait4(pid_t pid, int *status, int options, rusage *usage) noexcept {
  Thread *thread = me();
  if (thread == nullptr || (options & WNOHANG) != 0) return REAL(wait4)(pid, status, options, usage);
  Outside outside(*thread, "wait4");
  return REAL(wait4)(pid, status, options, usage);
}

RSLTRACE_EXPORT int waitid(idtype_t type, id_t id, siginfo_t *information, int options) {
  Thread *thread = me();
  if (thread == nullptr || (options & WNOHANG) != 0) return REAL(waitid)(type, id, information, options);
  Outside outside(*thread, "waitid");
  return REAL(waitid)(type, id, information, options);
}

RSLTRACE_EXPORT int system(const char *command) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(system)(command);
  Outside outside(*thread, "system");
  return REAL(system)(command);
}

RSLTRACE_EXPORT int pclose(FILE *stream) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pclose)(stream);
  Outside outside(*thread, "pclose");
  return REAL(pclose)(stream);
}

RSLTRACE_EXPORT unsigned alarm(unsigned seconds) noexcept {
  if (seconds > 0) tell_real_timer("alarm()");
  return REAL(alarm)(seconds);
}

RSLTRACE_EXPORT int setitimer(__itimer_which_t which, const itimerval *set, itimerval *old) noexcept {
  tell_real_timer("setitimer()");
  return REAL(setitimer)(which, set, old);
}

RSLTRACE_EXPORT int timer_create(clockid_t clock, sigevent *event, timer_t *timer) noexcept {
  tell_real_timer("timer_create()");
  return REAL(timer_create)(clock, event, timer);
}
