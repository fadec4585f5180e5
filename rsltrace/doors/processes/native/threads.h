// Who of the process's threads runs: one at a time.
#pragma once

#include "link.h"

namespace rsltrace {

// Give way to others until `waiter` has been woken.
void park(Waiter &waiter);
// Wake a thread that is parked in this process: it runs when its turn comes.
void wake(Waiter &waiter);
std::uint32_t this_thread();

}  // namespace rsltrace
