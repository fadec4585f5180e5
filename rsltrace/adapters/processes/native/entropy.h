// Chance from the job's seed.
#pragma once

#include <cstdint>

namespace rsltrace {

// SplitMix64 (Steele, Lea, Flood 2014): any seed will do.
std::uint64_t split_mix(std::uint64_t &state);
// In place of the random bytes that the kernel gives each program when it starts.
void exchange_start_bytes();
// Leave holes of all sizes in the heap, full of chance: what the program allocates then lies elsewhere,
// in another order, and is not zero.
void fragment_heap(std::uint64_t seed);

}  // namespace rsltrace
