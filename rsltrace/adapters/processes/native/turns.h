// Whose turn it is, in memory that the loop sees, too: who waits for a short time only is not woken.
#pragma once

#include <atomic>
#include <cstdint>

namespace rsltrace {

// What has been said begins behind it. Who sleeps says so, and looks once more; who hands over clears
// that, and wakes the other.
struct alignas(32) Turns {
  std::atomic<std::uint64_t> length;   // of what the process has said and the loop has not taken
  std::atomic<std::uint32_t> batches;  // that the process has said
  std::atomic<std::uint32_t> loop_sleeps;
  std::atomic<std::uint32_t> turns;  // that the loop has given
  std::atomic<std::uint32_t> process_sleeps;
  std::uint32_t may_spin;  // the loop does so, too, and counts
};

// Return whether the process has its next turn; if not, a byte comes with it.
bool has_turn(Turns &turns);

}  // namespace rsltrace
