// Processes of one thread: whoever waits, waits for the loop.
#include "threads.h"

namespace rsltrace {

void park(Waiter &waiter) {
  Waiter *one = &waiter;
  idle(&one, 1);
}

void wake(Waiter &waiter) { waiter.woken = true; }

std::uint32_t this_thread() { return 0; }

}  // namespace rsltrace
