#include "turns.h"

#include <sys/resource.h>

#include <algorithm>

#include "real.h"

namespace rsltrace {

namespace {

constexpr std::uint32_t SPINS = 4000;  // about 100 us: the loop may have to be woken itself
constexpr std::uint32_t PAUSE_MAX = 1024;  // turns
constexpr std::uint32_t LOOKS = 64;  // it is asked after so many turns whether others want the core

void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("isb" ::: "memory");
#endif
}

// Whether others have wanted this core since the last look: it is theirs while one waits.
bool is_contended() {
  static long last = 0;
  rusage used{};
  REAL(getrusage)(RUSAGE_THREAD, &used);
  const bool is = used.ru_nivcsw != last;
  last = used.ru_nivcsw;
  return is;
}

}  // namespace

bool has_turn(Turns &turns) {
  // The turn that comes next; for how many turns not to spin: now, after the next time in vain, and
  // after the next time that others have wanted the core.
  static std::uint32_t next = 0, rests = 0, pause = 0, spun = 0, yields = LOOKS;
  ++next;
  if (turns.may_spin == 0) return false;
  const auto is_there = [&] {
    return static_cast<std::int32_t>(turns.turns.load() - next) >= 0;
  };
  if (rests > 0) {
    --rests;
  } else {
    for (std::uint32_t left = SPINS; left > 0 && !is_there(); --left) relax();
    if (!is_there()) {
      rests = pause = std::min(2 * pause + 1, PAUSE_MAX);
    } else {
      pause /= 2;
      if (++spun % LOOKS == 0) {
        const bool is = is_contended();
        rests = is ? yields : 0;
        yields = is ? std::min(2 * yields, PAUSE_MAX) : std::max(yields / 2, LOOKS);
      }
    }
  }
  if (is_there()) return true;
  turns.process_sleeps.store(1);
  return is_there() && turns.process_sleeps.exchange(0) != 0;
}

}  // namespace rsltrace
