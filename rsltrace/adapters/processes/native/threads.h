// Who of the process's threads runs: one at a time. What the rest of the library needs to know.
#pragma once

#include <string>

#include "link.h"

namespace rsltrace {

// Give way to others until `waiter` has been woken.
void park(Waiter &waiter);
// Wake a thread that is parked in this process: it runs when its turn comes.
void wake(Waiter &waiter);
// The number of the calling thread: 0 is main, then in the order of creation.
std::uint32_t this_thread();

// While one of these exists, the thread asks the loop: it is not blocked outside, and signal handlers
// of it leave the scheduler alone.
class Asking {
 public:
  Asking();
  ~Asking();
  Asking(const Asking &) = delete;
  Asking &operator=(const Asking &) = delete;

 private:
  bool open_;
};

// Readable when the process wants to go on by itself: whoever idles must look at it.
int bell_fd();
// Send this process a signal, and return when main has handled it.
void raise_in_main(int signal);
// Each thread, what it waits for, and its stack.
std::string describe_threads();

}  // namespace rsltrace
