// A loop for the threads of one process alone: time jumps to whose deadline is next. In place of the
// link to rsltrace, so that threads are tested by themselves.
#include <poll.h>
#include <pthread.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>

#include "call_sites.h"
#include "link.h"
#include "threads.h"

namespace rsltrace {
namespace {

bool on = false;
std::int64_t now = 1'700'000'000'000'000'000;
std::uint64_t idles = 0;

void begin() {
  const char *mine = std::getenv("RSLTRACE_LONE");
  on = mine != nullptr;
  unsetenv("RSLTRACE_LONE");
  unsetenv("LD_PRELOAD");
  pthread_atfork(nullptr, nullptr, [] { on = false; });
}

std::int64_t real_ns() {
  timespec time;
  ::syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &time);
  return time.tv_sec * 1'000'000'000 + time.tv_nsec;
}

}  // namespace

__attribute__((constructor(101))) bool linked() {
  static bool begun = false;
  if (!begun) {
    begun = true;
    begin();
  }
  return on;
}
std::int64_t now_ns() { return now; }
std::uint64_t times_let_go() { return idles; }
std::int64_t shown_ns(std::uint32_t, bool) { return now; }
std::uint64_t seed() { return 42; }
bool has_instant_sleep() { return false; }
bool has_intra_process() { return false; }
bool is_own_code(const void *) { return false; }  // there is no trace to note anything in
void note_answer(Source, const char *, const std::string &, const void *) {}

void report(const std::string &text) { std::fprintf(stderr, "report: %s\n", text.c_str()); }

void idle(Waiter *const *waiters, std::size_t count, bool outside) {
  ++idles;
  Waiter *next = nullptr;
  for (std::size_t i = 0; i < count; ++i)
    if (waiters[i]->deadline_ns != NEVER_NS && (next == nullptr || waiters[i]->deadline_ns < next->deadline_ns))
      next = waiters[i];
  pollfd bell{bell_fd(), POLLIN, 0};
  const std::int64_t left = next == nullptr ? NEVER_NS : next->deadline_ns - now;
  timespec limit{static_cast<time_t>(left / 1'000'000'000), static_cast<long>(left % 1'000'000'000)};
  if (!outside && next == nullptr) {
    const char *patience = std::getenv("RSLTRACE_PATIENCE");  // for those that wait for signals
    limit = {patience == nullptr ? 0 : std::atol(patience), 0};
  } else if (!outside) {
    limit = {0, 0};
  }
  const std::int64_t before = real_ns();
  const long rung = ::syscall(SYS_ppoll, &bell, 1, &limit, nullptr, 8);
  if (rung != 0) {
    if (outside) now = std::min(now + real_ns() - before, next == nullptr ? NEVER_NS : next->deadline_ns);
    return;
  }
  if (next == nullptr) _exit(86);
  now = std::max(now, next->deadline_ns);
  next->woken = true;
}

}  // namespace rsltrace
