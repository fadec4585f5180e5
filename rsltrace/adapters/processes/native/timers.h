// Timers are rcl's, one by one: the loop knows when each of them is due, so it decides their order.
#pragma once

#include <rcl/timer.h>

#include <cstdint>
#include <vector>

namespace rsltrace {

// The number of a timer, 0 for one that was not made in a run.
std::uint32_t timer_id(const rcl_timer_t *timer);
// Tell the loop if the timer that it let run was for nobody's callback: an executor's own.
void say_passed();
// Tell the loop when these timers are due, where it does not know.
void say_deadlines(const std::vector<std::uint32_t> &timers);

}  // namespace rsltrace
