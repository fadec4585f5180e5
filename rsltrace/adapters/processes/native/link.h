// The link to the loop: what the process puts out goes there in one batch with each wait, and the
// loop says what runs next and what time it is.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "wire.h"

#define RSLTRACE_EXPORT extern "C" __attribute__((visibility("default")))

namespace rsltrace {

constexpr std::int64_t NEVER_NS = INT64_MAX;

enum class Wake : std::uint32_t { TIMEOUT = 0, ENTITY = 1, TIMER = 2, STOP = 3, GRAPH = 4 };

// What stands for all graph conditions among the numbers that are waited for.
constexpr std::uint32_t GRAPH_ID = UINT32_MAX;

struct Ready {
  Wake kind = Wake::TIMEOUT;
  std::uint32_t id = 0;
};

// What a thread waits for, by the numbers of entities and timers in this process. `set` names these
// towards the loop: a thread that waits for the same again says the same number.
struct WaitSet {
  std::uint32_t set = 0;
  std::vector<std::uint32_t> ids;
};

// One blocked thread; it lives on its stack.
struct Waiter {
  std::uint32_t thread = 0;
  std::int64_t deadline_ns = NEVER_NS;
  const WaitSet *set = nullptr;  // null: a sleep, or a wait of pthreads with a time
  const char *what = "";
  bool woken = false;
  Ready ready{};
};

// Whether a loop runs this process. If not (a grandchild, a forked copy), libc is what it was.
bool linked();
std::int64_t now_ns();
// How often the process was let go on.
std::uint64_t times_let_go();
// The entity or timer for which it was let go on last; 0 for none.
std::uint32_t last_ready();
// What clocks show to the program: simulated time, unless the job has other clocks for its nodes.
// `node` is whose clock it is (0: of who runs); a `look` at a clock of ROS may make it advance.
std::int64_t shown_ns(std::uint32_t node = 0, bool look = false);
// Whether the job has such clocks, and then whose one is that is made now (0: nobody's).
bool has_own_clocks();
std::uint32_t owner_of_new_clock();
// Whether sleeps take no simulated time.
bool has_instant_sleep();
// Whether nodes may keep messages within the process.
bool has_intra_process();
std::uint64_t seed();

// Append a record to the batch that the loop takes with the next wait or question, or if the process
// ends.
void say(Say kind, const void *body, std::size_t size);
void say(Say kind, const Writer &body);
// Send the batch with a question at its end, and return the answer.
std::vector<std::uint8_t> ask(Say kind, const Writer &body);
// No thread can run: send the batch with what is waited for, and return when one may go on, or
// nobody but the bell has rung (threads.h). While a thread is `outside`, simulated time goes no
// faster than real time.
void idle(Waiter *const *waiters, std::size_t count, bool outside);
// Tell the user something about this process.
void report(const std::string &text);

// The function that a name means in the ROS library which has it (ours comes before it).
void *original(const char *library, const char *name);

}  // namespace rsltrace
