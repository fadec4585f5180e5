// Processes of one thread: whoever waits, waits for the loop.
#include "threads.h"

#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

namespace rsltrace {

void park(Waiter &waiter) {
  if (syscall(SYS_gettid) != syscall(SYS_getpid)) {
    fprintf(stderr, "rsltrace: a thread of process %d waits for ROS (%s): so far only the main "
            "thread of a process can\n", getpid(), waiter.what);
    abort();
  }
  Waiter *one = &waiter;
  idle(&one, 1);
}

void wake(Waiter &waiter) { waiter.woken = true; }

std::uint32_t this_thread() { return 0; }

}  // namespace rsltrace
