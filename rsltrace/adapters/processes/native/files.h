// Waiting for descriptors.
#pragma once

#include <poll.h>

#include <vector>

#include "scheduler.h"

namespace rsltrace {

struct Files {
  std::vector<pollfd> list;
  bool outside = false;  // what it waits for may come from outside of the process
  bool signals = false;  // it waits for signals
};

// Wait until one of them is ready (by real poll), or the deadline. Not inside.
Outcome wait_for_files(Thread &thread, Files &files, std::int64_t deadline_ns, const char *what);
// Whether what is read from the descriptor may come from outside of the process; where from.
bool comes_from_outside(int descriptor, std::string &where);

// timerfds (timer_files.cpp): those that are due become readable; when the next is.
void fire_timer_files();
std::int64_t next_timer_file();

}  // namespace rsltrace
