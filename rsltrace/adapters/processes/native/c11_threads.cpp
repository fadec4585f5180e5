// The threads of C: glibc's are those of POSIX by another name, with locks of the same layout, but
// do not come to our functions.
#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <threads.h>
#include <time.h>

#include "real.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

int told(int failure) {
  switch (failure) {
    case 0: return thrd_success;
    case EBUSY: return thrd_busy;
    case ETIMEDOUT: return thrd_timedout;
    case ENOMEM: return thrd_nomem;
    default: return thrd_error;
  }
}

static_assert(sizeof(mtx_t) == sizeof(pthread_mutex_t));
static_assert(sizeof(cnd_t) == sizeof(pthread_cond_t) && sizeof(once_flag) == sizeof(pthread_once_t));

pthread_mutex_t *posix(mtx_t *lock) { return reinterpret_cast<pthread_mutex_t *>(lock); }
pthread_cond_t *posix(cnd_t *condition) { return reinterpret_cast<pthread_cond_t *>(condition); }

void *as_pointer(int result) { return reinterpret_cast<void *>(static_cast<std::intptr_t>(result)); }

struct Start {
  thrd_start_t function;
  void *argument;
};

void *run(void *data) {
  const Start start = *static_cast<Start *>(data);
  delete static_cast<Start *>(data);
  return as_pointer(start.function(start.argument));
}

}  // namespace

RSLTRACE_EXPORT int thrd_create(thrd_t *handle, thrd_start_t function, void *argument) {
  if (me() == nullptr) return REAL(thrd_create)(handle, function, argument);
  auto *start = new Start{function, argument};
  const int failure = pthread_create(handle, nullptr, run, start);
  if (failure != 0) delete start;
  return failure == EAGAIN ? thrd_nomem : told(failure);
}

RSLTRACE_EXPORT int thrd_join(thrd_t handle, int *result) {
  if (me() == nullptr) return REAL(thrd_join)(handle, result);
  void *returned = nullptr;
  const int failure = pthread_join(handle, &returned);
  if (failure == 0 && result != nullptr) *result = static_cast<int>(reinterpret_cast<std::intptr_t>(returned));
  return told(failure);
}

RSLTRACE_EXPORT int thrd_detach(thrd_t handle) {
  return me() == nullptr ? REAL(thrd_detach)(handle) : told(pthread_detach(handle));
}

RSLTRACE_EXPORT void thrd_exit(int result) { pthread_exit(as_pointer(result)); }

RSLTRACE_EXPORT int thrd_sleep(const timespec *span, timespec *left) {
  if (me() == nullptr) return REAL(thrd_sleep)(span, left);
  const int failure = clock_nanosleep(CLOCK_REALTIME, 0, span, left);
  return failure == 0 ? 0 : failure == EINTR ? -1 : -2;
}

RSLTRACE_EXPORT void thrd_yield() { sched_yield(); }

RSLTRACE_EXPORT int mtx_lock(mtx_t *lock) { return told(pthread_mutex_lock(posix(lock))); }
RSLTRACE_EXPORT int mtx_trylock(mtx_t *lock) { return told(pthread_mutex_trylock(posix(lock))); }
RSLTRACE_EXPORT int mtx_unlock(mtx_t *lock) { return told(pthread_mutex_unlock(posix(lock))); }
RSLTRACE_EXPORT int mtx_timedlock(mtx_t *__restrict lock, const timespec *__restrict when) {
  return told(pthread_mutex_timedlock(posix(lock), when));
}

RSLTRACE_EXPORT int cnd_wait(cnd_t *condition, mtx_t *lock) {
  return told(pthread_cond_wait(posix(condition), posix(lock)));
}
RSLTRACE_EXPORT int cnd_timedwait(cnd_t *__restrict condition, mtx_t *__restrict lock,
                                  const timespec *__restrict when) {
  return told(pthread_cond_timedwait(posix(condition), posix(lock), when));
}
RSLTRACE_EXPORT int cnd_signal(cnd_t *condition) { return told(pthread_cond_signal(posix(condition))); }
RSLTRACE_EXPORT int cnd_broadcast(cnd_t *condition) { return told(pthread_cond_broadcast(posix(condition))); }
RSLTRACE_EXPORT void cnd_destroy(cnd_t *condition) { pthread_cond_destroy(posix(condition)); }

RSLTRACE_EXPORT void call_once(once_flag *flag, void (*routine)()) {
  pthread_once(reinterpret_cast<pthread_once_t *>(flag), routine);
}
