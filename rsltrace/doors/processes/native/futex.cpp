// Futexes that a program waits on itself: std::atomic::wait, std::latch, std::future, static locals.
#include <linux/futex.h>
#include <sys/random.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <cstdarg>

#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

constexpr std::uint32_t ANY = FUTEX_BITSET_MATCH_ANY;

long fail(int error) {
  errno = error;
  return -1;
}

long wait_on(Thread &thread, std::uint32_t *word, std::uint32_t value, std::int64_t deadline_ns, std::uint32_t bits) {
  if (__atomic_load_n(word, __ATOMIC_SEQ_CST) != value) {
    look(thread, 1);
    return fail(EAGAIN);
  }
  Outcome outcome = Outcome::TIMEOUT;
  if (deadline_ns <= now_ns()) {
    look(thread, 100);
  } else {
    Inside inside(thread);
    thread.value = bits;
    outcome = wait_at(thread, Kind::FUTEX, word, deadline_ns, "a futex", true);
  }
  if (outcome == Outcome::WOKEN) return 0;
  return fail(outcome == Outcome::TIMEOUT ? ETIMEDOUT : EINTR);
}

long wake_up(Thread &thread, const std::uint32_t *word, std::uint32_t count, std::uint32_t bits) {
  Inside inside(thread);
  long woken = 0;
  for (std::size_t i = 0; i < waiting().size() && woken < static_cast<long>(count);) {
    Thread &one = *waiting()[i];
    if (one.kind == Kind::FUTEX && one.address == word && (one.value & bits) != 0) {
      wake(one, Outcome::WOKEN);
      ++woken;
    } else {
      ++i;
    }
  }
  return woken;
}

// Wake some, and have the others wait for another word.
long requeue(Thread &thread, const std::uint32_t *word, std::uint32_t count, std::uint32_t others,
             const std::uint32_t *target) {
  long moved = wake_up(thread, word, count, ANY);
  for (Thread *one : waiting()) {
    if (one->kind != Kind::FUTEX || one->address != word) continue;
    if (others-- == 0) break;
    one->address = target;
    ++moved;
  }
  return moved;
}

long do_futex(Thread &thread, const long *a) {
  auto *word = reinterpret_cast<std::uint32_t *>(a[0]);
  const auto value = static_cast<std::uint32_t>(a[2]);
  const auto *when = reinterpret_cast<const timespec *>(a[3]);
  const auto bits = static_cast<std::uint32_t>(a[5]);
  const auto *target = reinterpret_cast<const std::uint32_t *>(a[4]);
  switch (a[1] & FUTEX_CMD_MASK) {
    case FUTEX_WAIT:
      if (when != nullptr && !valid(when)) return fail(EINVAL);
      return wait_on(thread, word, value, when == nullptr ? NEVER_NS : deadline_after(*when), ANY);
    case FUTEX_WAIT_BITSET:
      if (bits == 0 || (when != nullptr && !valid(when))) return fail(EINVAL);
      return wait_on(thread, word, value, when == nullptr ? NEVER_NS : deadline_of(*when), bits);
    case FUTEX_WAKE: return wake_up(thread, word, value, ANY);
    case FUTEX_WAKE_BITSET: return bits == 0 ? fail(EINVAL) : wake_up(thread, word, value, bits);
    case FUTEX_CMP_REQUEUE:
      if (__atomic_load_n(word, __ATOMIC_SEQ_CST) != bits) return fail(EAGAIN);
      [[fallthrough]];
    case FUTEX_REQUEUE: return requeue(thread, word, value, static_cast<std::uint32_t>(a[3]), target);
    default: return REAL(syscall)(SYS_futex, a[0], a[1], a[2], a[3], a[4], a[5]);
  }
}

}  // namespace
}  // namespace rsltrace

using namespace rsltrace;

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
    case SYS_sched_yield: thread = me(); break;
    default: break;
  }
  if (thread != nullptr) switch (number) {
      case SYS_futex: return do_futex(*thread, a);
      case SYS_getrandom:
        return getrandom(reinterpret_cast<void *>(a[0]), static_cast<std::size_t>(a[1]), static_cast<unsigned>(a[2]));
      case SYS_clock_gettime: return clock_gettime(static_cast<clockid_t>(a[0]), reinterpret_cast<timespec *>(a[1]));
      case SYS_clock_nanosleep: {
        const int failure =
            clock_nanosleep(static_cast<clockid_t>(a[0]), static_cast<int>(a[1]),
                            reinterpret_cast<const timespec *>(a[2]), reinterpret_cast<timespec *>(a[3]));
        return failure == 0 ? 0 : fail(failure);
      }
      case SYS_nanosleep:
        return nanosleep(reinterpret_cast<const timespec *>(a[0]), reinterpret_cast<timespec *>(a[1]));
      case SYS_sched_yield: yield(*thread); return 0;
      default: break;
    }
  return REAL(syscall)(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}
