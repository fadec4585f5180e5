// Calls that a thread sleeps in, as /proc/self/task/*/syscall has them: the number, then arguments.
#pragma once

#include <string>

namespace rsltrace {

// What to call it, and what it waits for.
std::string name_of_call(const char *line);
// Whether it prints, to who is slow to read it: it comes back by itself and with the same result,
// however long it takes, so that simulated time can wait for it.
bool prints(const char *line);
// Take note of where the process prints to.
void remember_streams();

}  // namespace rsltrace
