// The lines of the program's own code that draw, look at clocks and publish: addresses here, lines there.
#pragma once

#include <dlfcn.h>

#include <cstdint>
#include <string>

#include "wire.h"

namespace rsltrace {

// The numbers are those of ../process.py.
enum class Source : std::uint32_t { RANDOM = 0, CLOCK = 1, PID = 2, VARIABLE = 3 };

// Whether a file is none of the program's own: ROS's, libc's or the C++ library's. Takes no memory of
// the heap: how long paths are must not show in the program's addresses.
bool is_library(const Dl_info &info);
// Whether a call comes from the program's own code: none of ROS, libc or the C++ library.
bool is_own_code(const void *caller);
// Put into the trace what the program's own code got from a call. `where` is where it returns to.
// Of what one place draws in an event, these are the first answers; `note_latest_draws` puts the last.
void note_answer(Source source, const char *call, const std::string &answer, const void *where);
void note_latest_draws();
// The same of an environment variable, null if it is not set.
void note_variable(const char *name, const char *value, const void *where);
// Append the frames of the program's own code that make something, innermost first: none if ROS
// itself makes it. `caller` is where the function that ROS's templates call returns to.
void write_maker(Writer &body, const void *caller);
// Say from where an endpoint is about to send, the first times from each callback.
void note_sender(std::uint32_t id);

}  // namespace rsltrace

// Only what the program itself calls is worth a text.
#define RSLTRACE_NOTE(source, call, answer)                                        \
  do {                                                                             \
    const void *caller = __builtin_return_address(0);                              \
    if (is_own_code(caller)) note_answer(source, call, answer, caller);            \
  } while (false)
