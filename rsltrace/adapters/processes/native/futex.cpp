// Futexes that a program waits on itself: std::atomic::wait, std::latch, std::future, static locals.
#include <linux/futex.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

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

}  // namespace

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

}  // namespace rsltrace
