// Threads begin, end, are joined, cancelled and sent signals.
#include <pthread.h>
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

// libc calls a thread's destructors this often while they set values again. The thread has left the
// program's code after the last time.
constexpr int ROUNDS = 4;
pthread_key_t key;

void *run(void *record) {
  auto &thread = *static_cast<Thread *>(record);
  self = &thread;
  thread.tid = static_cast<pid_t>(REAL(syscall)(SYS_gettid));
  pthread_setspecific(key, &thread);
  stand(thread);
  thread.state = State::RUNNING;
  thread.open.store(true);
  return thread.routine(thread.argument);
}

void destruct(void *record) {
  auto &thread = *static_cast<Thread *>(record);
  if (!linked()) return;
  if (++thread.rounds < ROUNDS) {
    pthread_setspecific(key, &thread);
  } else if (me() == &thread) {
    thread.open.store(false);
    end(thread);
  }
}

void only_a_copy() {
  if (self != nullptr) self->open.store(false);
}

// If no library's constructor has come to us: before those of the program.
__attribute__((constructor(102))) void begin() { me(); }

int join(pthread_t handle, void **result, std::int64_t deadline_ns, const char *what) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_join)(handle, result);
  pthread_testcancel();
  Thread *other = find(handle);
  if (other == nullptr || other == thread || other->detached || other->joining)
    return REAL(pthread_join)(handle, result);
  other->joining = true;
  struct Unmark {
    Thread *other;
    ~Unmark() {
      if (other != nullptr) other->joining = false;
    }
  } unmark{other};
  while (other->state != State::ENDED) {
    Outcome outcome = Outcome::TIMEOUT;
    if (deadline_ns > now_ns()) {
      Inside inside(*thread);
      outcome = wait_at(*thread, Kind::JOIN, other, deadline_ns, what, true);
    } else {
      look(*thread, 100);
    }
    pthread_testcancel();
    if (outcome == Outcome::TIMEOUT) return ETIMEDOUT;
  }
  Inside inside(*thread);
  unmark.other = nullptr;
  forget(*other);
  delete other;
  return REAL(pthread_join)(handle, result);
}

}  // namespace

void prepare_threads(Thread &main) {
  pthread_key_create(&key, destruct);
  pthread_atfork(nullptr, nullptr, only_a_copy);
  pthread_setspecific(key, &main);
  start_service();
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT int pthread_create(pthread_t *handle, const pthread_attr_t *attributes,
                                   void *(*routine)(void *), void *argument) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_create)(handle, attributes, routine, argument);
  Inside inside(*thread);
  auto *child = new Thread;
  child->routine = routine;
  child->argument = argument;
  child->what = "start";
  int state = PTHREAD_CREATE_JOINABLE;
  if (attributes != nullptr) pthread_attr_getdetachstate(attributes, &state);
  child->detached = state == PTHREAD_CREATE_DETACHED;
  const int failure = REAL(pthread_create)(&child->handle, attributes, run, child);
  if (failure != 0) {
    delete child;
    return failure;
  }
  *handle = child->handle;
  add(*child);
  return 0;
}

RSLTRACE_EXPORT int pthread_join(pthread_t handle, void **result) {
  return join(handle, result, NEVER_NS, "pthread_join");
}

RSLTRACE_EXPORT int pthread_timedjoin_np(pthread_t handle, void **result, const timespec *when) {
  if (me() == nullptr) return REAL(pthread_timedjoin_np)(handle, result, when);
  if (when != nullptr && !valid(when)) return EINVAL;
  return join(handle, result, when == nullptr ? NEVER_NS : deadline_of(*when), "pthread_timedjoin_np");
}

RSLTRACE_EXPORT int pthread_clockjoin_np(pthread_t handle, void **result, clockid_t clock, const timespec *when) {
  if (me() == nullptr) return REAL(pthread_clockjoin_np)(handle, result, clock, when);
  return pthread_timedjoin_np(handle, result, when);
}

RSLTRACE_EXPORT int pthread_tryjoin_np(pthread_t handle, void **result) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_tryjoin_np)(handle, result);
  Thread *other = find(handle);
  if (other != nullptr && other->state != State::ENDED) {
    look(*thread, 100);
    return EBUSY;
  }
  return pthread_join(handle, result);
}

RSLTRACE_EXPORT int pthread_detach(pthread_t handle) noexcept {
  Thread *thread = me();
  Thread *other = thread == nullptr ? nullptr : find(handle);
  const int failure = REAL(pthread_detach)(handle);
  if (failure != 0 || other == nullptr) return failure;
  Inside inside(*thread);
  other->detached = true;
  if (other->state == State::ENDED) {
    forget(*other);
    delete other;
  }
  return 0;
}

RSLTRACE_EXPORT int pthread_cancel(pthread_t handle) {
  const int failure = REAL(pthread_cancel)(handle);
  Thread *thread = me();
  if (thread == nullptr || failure != 0) return failure;
  Inside inside(*thread);
  Thread *other = find(handle);
  if (other != nullptr && other->state == State::WAITING && other->interruptible)
    wake(*other, Outcome::INTERRUPTED);
  return 0;
}

RSLTRACE_EXPORT int pthread_kill(pthread_t handle, int signal) noexcept {
  Thread *thread = me();
  if (thread == nullptr || signal == 0) return REAL(pthread_kill)(handle, signal);
  Thread *other = find(handle);
  if (other == nullptr || other == thread) return REAL(pthread_kill)(handle, signal);
  Inside inside(*thread);
  return order(*other, Order::RAISE, signal) ? 0 : REAL(pthread_kill)(handle, signal);
}

RSLTRACE_EXPORT int kill(pid_t pid, int signal) noexcept {
  Thread *thread = me();
  if (thread == nullptr || signal == 0 || pid != REAL(getpid)() || thread->number == 0)
    return REAL(kill)(pid, signal);
  Inside inside(*thread);
  Thread *main = owner(pid);
  return main != nullptr && order(*main, Order::KILL, signal) ? 0 : REAL(kill)(pid, signal);
}
