// Condition variables, barriers, semaphores.
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>

#include <cstdarg>
#include <map>
#include <set>

#include "real.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

bool between_processes(const pthread_cond_t *condition) {
  constexpr unsigned shared = 1;  // of glibc's flags
  return (condition->__data.__wrefs & shared) != 0;
}

// Condition variables keep nothing of their own: who waits is in the scheduler's list.
int wait_on(Thread &thread, pthread_cond_t *condition, pthread_mutex_t *mutex, std::int64_t deadline_ns,
            const char *what) {
  pthread_testcancel();
  Outcome outcome = Outcome::TIMEOUT;
  if (deadline_ns <= now_ns()) {
    if (const int failure = pthread_mutex_unlock(mutex)) return failure;
    yield(thread);
  } else {
    Inside inside(thread);
    if (const int failure = REAL(pthread_mutex_unlock)(mutex)) return failure;
    unlocked(mutex);
    arrive(thread, Kind::CONDITION, condition, deadline_ns, what, true);
    outcome = give_way(thread);
  }
  if (const int failure = pthread_mutex_lock(mutex)) return failure;
  if (outcome == Outcome::INTERRUPTED) pthread_testcancel();  // cleanup handlers have the mutex
  return outcome == Outcome::TIMEOUT ? ETIMEDOUT : 0;
}

// Wakes one or all. Between processes, libc does it.
int notify(pthread_cond_t *condition, bool everybody, int (*libc)(pthread_cond_t *)) {
  Thread *thread = me();
  if (thread == nullptr || between_processes(condition)) return libc(condition);
  if (waiting().empty()) return 0;
  Inside inside(*thread);
  while (Thread *one = first(condition, Kind::CONDITION)) {
    wake(*one, Outcome::WOKEN);
    if (!everybody) break;
  }
  return 0;
}

}  // namespace

RSLTRACE_EXPORT int pthread_cond_wait(pthread_cond_t *condition, pthread_mutex_t *mutex) {
  Thread *thread = me();
  if (thread == nullptr || between_processes(condition)) return REAL(pthread_cond_wait)(condition, mutex);
  return wait_on(*thread, condition, mutex, NEVER_NS, "pthread_cond_wait");
}

RSLTRACE_EXPORT int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const timespec *when) {
  Thread *thread = me();
  if (thread == nullptr || between_processes(condition))
    return REAL(pthread_cond_timedwait)(condition, mutex, when);
  if (!valid(when)) return EINVAL;
  return wait_on(*thread, condition, mutex, deadline_of(*when), "pthread_cond_timedwait");
}

RSLTRACE_EXPORT int pthread_cond_clockwait(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
                                           const timespec *when) {
  Thread *thread = me();
  if (thread == nullptr || between_processes(condition))
    return REAL(pthread_cond_clockwait)(condition, mutex, clock, when);
  if (!valid(when)) return EINVAL;
  return wait_on(*thread, condition, mutex, deadline_of(*when), "pthread_cond_clockwait");
}

RSLTRACE_EXPORT int pthread_cond_signal(pthread_cond_t *condition) noexcept {
  return notify(condition, false, REAL(pthread_cond_signal));
}

RSLTRACE_EXPORT int pthread_cond_broadcast(pthread_cond_t *condition) noexcept {
  return notify(condition, true, REAL(pthread_cond_broadcast));
}

// libc would wait for threads that it never saw wait.
RSLTRACE_EXPORT int pthread_cond_destroy(pthread_cond_t *condition) noexcept {
  return me() == nullptr || between_processes(condition) ? REAL(pthread_cond_destroy)(condition) : 0;
}

namespace {

struct Barrier {
  unsigned needed = 0;
  unsigned arrived = 0;
};

std::map<pthread_barrier_t *, Barrier> &barriers() {
  static auto *map = new std::map<pthread_barrier_t *, Barrier>;
  return *map;
}

}  // namespace

RSLTRACE_EXPORT int pthread_barrier_init(pthread_barrier_t *barrier, const pthread_barrierattr_t *attributes,
                                         unsigned count) noexcept {
  const int failure = REAL(pthread_barrier_init)(barrier, attributes, count);
  Thread *thread = me();
  int shared = PTHREAD_PROCESS_PRIVATE;
  if (attributes != nullptr) pthread_barrierattr_getpshared(attributes, &shared);
  if (thread == nullptr || failure != 0 || shared == PTHREAD_PROCESS_SHARED) return failure;
  Inside inside(*thread);
  barriers()[barrier] = Barrier{count, 0};
  return 0;
}

RSLTRACE_EXPORT int pthread_barrier_destroy(pthread_barrier_t *barrier) noexcept {
  if (Thread *thread = me()) {
    Inside inside(*thread);
    barriers().erase(barrier);
  }
  return REAL(pthread_barrier_destroy)(barrier);
}

RSLTRACE_EXPORT int pthread_barrier_wait(pthread_barrier_t *barrier) noexcept {
  Thread *thread = me();
  if (thread == nullptr || barriers().count(barrier) == 0) return REAL(pthread_barrier_wait)(barrier);
  Inside inside(*thread);
  Barrier &one = barriers()[barrier];
  if (++one.arrived < one.needed) {
    wait_at(*thread, Kind::BARRIER, barrier, NEVER_NS, "pthread_barrier_wait");
    return 0;
  }
  one.arrived = 0;
  while (Thread *other = first(barrier, Kind::BARRIER)) wake(*other, Outcome::WOKEN);
  return PTHREAD_BARRIER_SERIAL_THREAD;
}

namespace {

// Semaphores that other processes have, too: libc waits for them.
std::set<sem_t *> &shared_semaphores() {
  static auto *set = new std::set<sem_t *>;
  return *set;
}

// The semaphore that was tried last and not got, if none was got since. Python asks so whether it has
// a lock itself (`Condition.notify`): only who asks for the same one again and again goes in a loop.
sem_t *tried;

int wait_for(Thread &thread, sem_t *semaphore, std::int64_t deadline_ns, const char *what) {
  pthread_testcancel();
  tried = nullptr;
  if (!anyone(semaphore, Kind::SEMAPHORE) && REAL(sem_trywait)(semaphore) == 0) return 0;
  Outcome outcome = Outcome::TIMEOUT;
  if (deadline_ns <= now_ns()) {
    look(thread, 100);
  } else if (shared_semaphores().count(semaphore) != 0) {
    Outside outside(thread, "sem_wait of a semaphore shared between processes");
    return REAL(sem_wait)(semaphore);
  } else {
    Inside inside(thread);
    outcome = wait_at(thread, Kind::SEMAPHORE, semaphore, deadline_ns, what, true);
  }
  if (outcome == Outcome::WOKEN) return 0;
  if (outcome == Outcome::INTERRUPTED) pthread_testcancel();
  errno = outcome == Outcome::TIMEOUT ? ETIMEDOUT : EINTR;
  return -1;
}

}  // namespace

namespace rsltrace {

// Signal handlers post to libc's semaphore; what they posted goes to who waits.
void post_semaphores() {
  bool woken = true;
  while (woken) {
    woken = false;
    for (Thread *thread : waiting())
      if (thread->kind == Kind::SEMAPHORE &&
          REAL(sem_trywait)(static_cast<sem_t *>(const_cast<void *>(thread->address))) == 0) {
        wake(*thread, Outcome::WOKEN);
        woken = true;
        break;
      }
  }
}

}  // namespace rsltrace

RSLTRACE_EXPORT int sem_wait(sem_t *semaphore) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sem_wait)(semaphore);
  return wait_for(*thread, semaphore, NEVER_NS, "sem_wait");
}

RSLTRACE_EXPORT int sem_timedwait(sem_t *semaphore, const timespec *when) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sem_timedwait)(semaphore, when);
  if (!valid(when)) return errno = EINVAL, -1;
  return wait_for(*thread, semaphore, deadline_of(*when), "sem_timedwait");
}

RSLTRACE_EXPORT int sem_clockwait(sem_t *semaphore, clockid_t clock, const timespec *when) {
  if (me() == nullptr) return REAL(sem_clockwait)(semaphore, clock, when);
  return sem_timedwait(semaphore, when);
}

RSLTRACE_EXPORT int sem_trywait(sem_t *semaphore) noexcept {
  Thread *thread = me();
  const int result = REAL(sem_trywait)(semaphore);
  if (thread == nullptr) return result;
  const bool again = tried == semaphore;
  tried = result == 0 ? nullptr : semaphore;
  if (result != 0) {
    const int error = errno;
    look(*thread, again ? 100 : 1);
    errno = error;
  }
  return result;
}

RSLTRACE_EXPORT int sem_post(sem_t *semaphore) noexcept {
  Thread *thread = me();
  if (thread == nullptr) {
    const int result = REAL(sem_post)(semaphore);
    if (linked()) ring(true);
    return result;
  }
  if (waiting().empty()) return REAL(sem_post)(semaphore);
  Inside inside(*thread);
  Thread *one = first(semaphore, Kind::SEMAPHORE);
  if (one == nullptr) return REAL(sem_post)(semaphore);
  wake(*one, Outcome::WOKEN);
  return 0;
}

RSLTRACE_EXPORT int sem_init(sem_t *semaphore, int shared, unsigned value) noexcept {
  Thread *thread = me();
  if (thread != nullptr) {
    Inside inside(*thread);
    if (shared != 0)
      shared_semaphores().insert(semaphore);
    else
      shared_semaphores().erase(semaphore);
  }
  return REAL(sem_init)(semaphore, shared, value);
}

RSLTRACE_EXPORT sem_t *sem_open(const char *name, int flags, ...) noexcept {
  va_list rest;
  va_start(rest, flags);
  const bool creates = (flags & O_CREAT) != 0;
  const mode_t mode = creates ? va_arg(rest, mode_t) : 0;
  const unsigned value = creates ? va_arg(rest, unsigned) : 0;
  va_end(rest);
  sem_t *semaphore = REAL(sem_open)(name, flags, mode, value);
  Thread *thread = me();
  if (thread != nullptr && semaphore != SEM_FAILED) {
    Inside inside(*thread);
    shared_semaphores().insert(semaphore);
  }
  return semaphore;
}
