// Clocks of ROS that something else than the loop drives.
#pragma once

#include <rcl/time.h>

namespace rsltrace {

// Whether a clock shows what /clock says (or whoever sets it by hand), because the job lets it.
bool is_driven(const rcl_clock_t &clock);
// Whether it may come to that: then its timers are to be looked at whenever it is set.
bool may_be_driven(const rcl_clock_t &clock);

}  // namespace rsltrace
