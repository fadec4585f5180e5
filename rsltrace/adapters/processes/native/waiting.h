// Waiting for one of many. Who waits with a time gets exactly one thing that is ready; who only looks
// (a wait without a time, as spin_some has it) gets all of them, since it may not look again soon.
#pragma once

#include <cstdint>
#include <vector>

#include "endpoints.h"
#include "guard_conditions.h"

namespace rsltrace {

// What is waited for, in the order in which it was named. `place` is where the caller has it.
struct Wanted {
  struct Condition {
    GuardCondition *condition;
    std::size_t place;
  };
  struct Receiver {
    Endpoint *endpoint;
    std::size_t place;
    std::uint32_t kind;
  };
  std::vector<Condition> conditions;
  std::vector<Receiver> receivers;
  std::vector<std::uint32_t> timers;
  bool only_new = false;  // what has been handed over before does not count
};

struct Found {
  enum class Kind { NOTHING, CONDITION, RECEIVER, TIMER } kind = Kind::NOTHING;
  std::size_t index = 0;  // in its list of Wanted
};

// Wait until one of them is ready, or until `timeout_ns` have passed (below 0: for ever).
Found wait_for_one(const Wanted &wanted, std::int64_t timeout_ns, const char *what);
// As that, but a wait without a time finds all that is ready, in the order of the loop, and so does not
// let the loop run any of it: the event of each begins where it is taken (await_turn). What a guard
// condition ends that would have gone on for some time finds one thing beside it, in the same way.
std::vector<Found> wait_for(const Wanted &wanted, std::int64_t timeout_ns, const char *what);
// What a wait without a time finds, without the millisecond that it takes if that is nothing.
std::vector<Found> ready_now(const Wanted &wanted);
// Wake whoever waits for an endpoint beside the one whom the loop lets go on.
void wake_receivers(std::uint32_t endpoint);
// Have the loop let run what was found so, before it is taken, or the timer called.
void await_turn(Endpoint &endpoint);
void await_turn(std::uint32_t timer);

// The least that a wait takes that does not want to wait: without it, who polls would stop time.
constexpr std::int64_t POLL_NS = 1'000'000;

}  // namespace rsltrace
