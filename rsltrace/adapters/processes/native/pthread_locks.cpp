// Mutexes, spin locks, read-write locks, once. The locks themselves stay libc's, and are only ever
// tried: who would have to wait, waits here. A lock that is given back is kept for who has waited
// longest, until that thread runs.
#include <pthread.h>

#include <map>

#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

constexpr int SHARED = 128;  // of a mutex's kind, in glibc: between processes

int kind_of(const pthread_mutex_t *mutex) { return mutex->__data.__kind; }
bool mine(const pthread_mutex_t *mutex, const Thread &thread) { return mutex->__data.__owner == thread.tid; }

int lock_slowly(Thread &thread, pthread_mutex_t *mutex, std::int64_t deadline_ns, const char *what) {
  if (mine(mutex, thread)) {
    const int type = kind_of(mutex) & 3;
    if (type == PTHREAD_MUTEX_RECURSIVE) return REAL(pthread_mutex_trylock)(mutex);
    if (type == PTHREAD_MUTEX_ERRORCHECK) return EDEADLK;
  }
  if (locks_waited_for == 0 || !anyone(mutex, Kind::MUTEX)) {
    const int result = REAL(pthread_mutex_trylock)(mutex);
    if (result != EBUSY) return result;
  }
  if (kind_of(mutex) & SHARED) {
    Outside outside(thread, "pthread_mutex_lock of a mutex shared between processes");
    return REAL(pthread_mutex_lock)(mutex);
  }
  if (deadline_ns <= now_ns()) {
    look(thread, 100);
    return ETIMEDOUT;
  }
  Inside inside(thread);
  arrive(thread, Kind::MUTEX, mutex, deadline_ns, what);
  if (deadline_ns == NEVER_NS) lock_cycle(thread);
  if (give_way(thread) == Outcome::TIMEOUT) return ETIMEDOUT;
  took(thread);
  return REAL(pthread_mutex_trylock)(mutex);
}

}  // namespace

void unlocked(const pthread_mutex_t *mutex) {
  if (locks_waited_for == 0 || mutex->__data.__owner != 0) return;  // recursive, and still held
  for (Thread *one : waiting())
    if (one->address == mutex && one->kind == Kind::MUTEX) {
      if (!one->granted) wake(*one, Outcome::WOKEN, true);
      return;
    }
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT int pthread_mutex_lock(pthread_mutex_t *mutex) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_mutex_lock)(mutex);
  if (locks_waited_for == 0) {
    const int result = REAL(pthread_mutex_trylock)(mutex);
    if (result != EBUSY) return result;
  }
  return lock_slowly(*thread, mutex, NEVER_NS, "pthread_mutex_lock");
}

RSLTRACE_EXPORT int pthread_mutex_trylock(pthread_mutex_t *mutex) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_mutex_trylock)(mutex);
  if (locks_waited_for == 0 || mine(mutex, *thread) || !anyone(mutex, Kind::MUTEX)) {
    const int result = REAL(pthread_mutex_trylock)(mutex);
    if (result != EBUSY) return result;
  }
  look(*thread, 100);
  return EBUSY;
}

RSLTRACE_EXPORT int pthread_mutex_timedlock(pthread_mutex_t *mutex, const timespec *when) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_mutex_timedlock)(mutex, when);
  if (!valid(when)) return EINVAL;
  return lock_slowly(*thread, mutex, deadline_of(*when), "pthread_mutex_timedlock");
}

RSLTRACE_EXPORT int pthread_mutex_clocklock(pthread_mutex_t *mutex, clockid_t clock, const timespec *when) noexcept {
  if (me() == nullptr) return REAL(pthread_mutex_clocklock)(mutex, clock, when);
  return pthread_mutex_timedlock(mutex, when);
}

RSLTRACE_EXPORT int pthread_mutex_unlock(pthread_mutex_t *mutex) noexcept {
  Thread *thread = me();
  const int result = REAL(pthread_mutex_unlock)(mutex);
  if (thread != nullptr && locks_waited_for != 0 && result == 0) {
    Inside inside(*thread);
    unlocked(mutex);
  }
  return result;
}

RSLTRACE_EXPORT int pthread_spin_lock(pthread_spinlock_t *lock) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pthread_spin_lock)(lock);
  while (REAL(pthread_spin_trylock)(lock) == EBUSY) yield(*thread);
  return 0;
}

RSLTRACE_EXPORT int pthread_spin_trylock(pthread_spinlock_t *lock) noexcept {
  Thread *thread = me();
  const int result = REAL(pthread_spin_trylock)(lock);
  if (thread != nullptr && result == EBUSY) look(*thread, 100);
  return result;
}

namespace rsltrace {
namespace {

const void *plain(pthread_rwlock_t *lock) { return lock; }

bool granted(const void *lock, Kind kind) {
  for (Thread *one : waiting())
    if (one->address == lock && one->kind == kind && one->granted) return true;
  return false;
}

bool may_read(pthread_rwlock_t *lock) {
  if (granted(plain(lock), Kind::WRITE)) return false;
  const bool writers_first = lock->__data.__flags == PTHREAD_RWLOCK_PREFER_WRITER_NONRECURSIVE_NP;
  return !writers_first || first(plain(lock), Kind::WRITE) == nullptr;
}

bool may_write(pthread_rwlock_t *lock) {
  return !granted(plain(lock), Kind::WRITE) && !granted(plain(lock), Kind::READ);
}

int try_lock(pthread_rwlock_t *lock, Kind kind) {
  if (kind == Kind::READ) return may_read(lock) ? REAL(pthread_rwlock_tryrdlock)(lock) : EBUSY;
  return may_write(lock) ? REAL(pthread_rwlock_trywrlock)(lock) : EBUSY;
}

// The lock became free for some: keep it for the writer, or the readers, who have waited longest.
void grant(pthread_rwlock_t *lock) {
  if (granted(plain(lock), Kind::WRITE)) return;
  std::vector<Thread *> next;
  for (Thread *one : waiting()) {
    if (one->address != lock || one->granted || (one->kind != Kind::READ && one->kind != Kind::WRITE)) continue;
    if (!next.empty() && one->kind == Kind::WRITE) break;
    next.push_back(one);
    if (one->kind == Kind::WRITE) break;
  }
  if (next.empty()) return;
  const bool write = next.front()->kind == Kind::WRITE;
  if (write && granted(plain(lock), Kind::READ)) return;
  if ((write ? REAL(pthread_rwlock_trywrlock) : REAL(pthread_rwlock_tryrdlock))(lock) != 0) return;
  REAL(pthread_rwlock_unlock)(lock);
  for (Thread *one : next) wake(*one, Outcome::WOKEN, true);
}

int lock_rw(Thread &thread, pthread_rwlock_t *lock, Kind kind, std::int64_t deadline_ns, const char *what) {
  const int result = try_lock(lock, kind);
  if (result != EBUSY) return result;
  if (lock->__data.__cur_writer == thread.tid) return EDEADLK;
  if (deadline_ns <= now_ns()) {
    look(thread, 100);
    return ETIMEDOUT;
  }
  Inside inside(thread);
  if (wait_at(thread, kind, lock, deadline_ns, what) == Outcome::TIMEOUT) {
    grant(lock);  // readers may have waited behind this writer
    return ETIMEDOUT;
  }
  took(thread);
  return (kind == Kind::READ ? REAL(pthread_rwlock_tryrdlock) : REAL(pthread_rwlock_trywrlock))(lock);
}

}  // namespace
}  // namespace rsltrace

#define RSLTRACE_RWLOCK(way, KIND)                                                                     \
  RSLTRACE_EXPORT int pthread_rwlock_##way##lock(pthread_rwlock_t *lock) noexcept {                    \
    Thread *thread = me();                                                                             \
    if (thread == nullptr) return REAL(pthread_rwlock_##way##lock)(lock);                              \
    return lock_rw(*thread, lock, KIND, NEVER_NS, "pthread_rwlock_" #way "lock");                      \
  }                                                                                                    \
  RSLTRACE_EXPORT int pthread_rwlock_try##way##lock(pthread_rwlock_t *lock) noexcept {                 \
    Thread *thread = me();                                                                             \
    if (thread == nullptr) return REAL(pthread_rwlock_try##way##lock)(lock);                           \
    const int result = try_lock(lock, KIND);                                                           \
    if (result == EBUSY) look(*thread, 100);                                                           \
    return result;                                                                                     \
  }                                                                                                    \
  RSLTRACE_EXPORT int pthread_rwlock_timed##way##lock(pthread_rwlock_t *lock, const timespec *when)    \
      noexcept {                                                                                       \
    Thread *thread = me();                                                                             \
    if (thread == nullptr) return REAL(pthread_rwlock_timed##way##lock)(lock, when);                   \
    if (!valid(when)) return EINVAL;                                                                   \
    return lock_rw(*thread, lock, KIND, deadline_of(*when), "pthread_rwlock_timed" #way "lock");       \
  }                                                                                                    \
  RSLTRACE_EXPORT int pthread_rwlock_clock##way##lock(pthread_rwlock_t *lock, clockid_t clock,         \
                                                      const timespec *when) noexcept {                 \
    if (me() == nullptr) return REAL(pthread_rwlock_clock##way##lock)(lock, clock, when);              \
    return pthread_rwlock_timed##way##lock(lock, when);                                                \
  }

RSLTRACE_RWLOCK(rd, Kind::READ)
RSLTRACE_RWLOCK(wr, Kind::WRITE)

RSLTRACE_EXPORT int pthread_rwlock_unlock(pthread_rwlock_t *lock) noexcept {
  Thread *thread = me();
  const int result = REAL(pthread_rwlock_unlock)(lock);
  if (thread == nullptr || result != 0 || waiting().empty()) return result;
  Inside inside(*thread);
  grant(lock);
  return result;
}

namespace rsltrace {
namespace {

// Who runs a once routine now; libc only hears of those that are done.
std::map<pthread_once_t *, Thread *> &once_running() {
  static auto *map = new std::map<pthread_once_t *, Thread *>;
  return *map;
}

constexpr int ONCE_DONE = 2;  // of glibc

}  // namespace
}  // namespace rsltrace

RSLTRACE_EXPORT int pthread_once(pthread_once_t *control, void (*routine)()) {
  Thread *thread = me();
  if (thread == nullptr || (*control & ONCE_DONE) != 0) return REAL(pthread_once)(control, routine);
  {
    Inside inside(*thread);
    while (once_running().count(control) != 0)
      wait_at(*thread, Kind::ONCE, control, NEVER_NS, "pthread_once");
    if ((*control & ONCE_DONE) != 0) return 0;
    once_running()[control] = thread;
  }
  struct Finished {  // also if the routine throws, or its thread is cancelled: the next one tries
    pthread_once_t *control;
    Thread *thread;
    bool returned = false;
    ~Finished() {
      Inside inside(*thread);
      if (returned) REAL(pthread_once)(control, [] {});
      once_running().erase(control);
      while (Thread *other = first(control, Kind::ONCE)) wake(*other, Outcome::WOKEN);
    }
  } finished{control, thread};
  routine();
  finished.returned = true;
  return 0;
}
