// Every clock shows simulated time, and sleeping is waiting for it.
#include <sched.h>
#include <stdio.h>
#include <sys/resource.h>
#include <sys/time.h>
#include <sys/timeb.h>
#include <sys/times.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <string>

#include "call_sites.h"
#include "real.h"
#include "scheduler.h"

namespace rsltrace {

constexpr std::int64_t SECOND_NS = 1'000'000'000;

bool valid(const timespec *when) { return when->tv_nsec >= 0 && when->tv_nsec < SECOND_NS; }

namespace {

std::int64_t length_of(const timespec &span) {
  if (span.tv_sec >= NEVER_NS / SECOND_NS) return NEVER_NS;
  return span.tv_sec < 0 ? 0 : span.tv_sec * SECOND_NS + span.tv_nsec;
}

}  // namespace

// A time of the program's clock, which may be wrong: what is left until then is waited for.
std::int64_t deadline_of(const timespec &when) {
  const std::int64_t shown = length_of(when);
  const std::int64_t ahead = shown == NEVER_NS ? 0 : shown_ns() - now_ns();
  return std::max<std::int64_t>(shown - ahead, 0);
}

std::int64_t deadline_after(const timespec &span) {
  const std::int64_t length = length_of(span);
  const std::int64_t now = now_ns();
  return length >= NEVER_NS - now ? NEVER_NS : now + length;
}

namespace {

timespec to_timespec(std::int64_t ns) {
  return {static_cast<time_t>(ns / SECOND_NS), static_cast<long>(ns % SECOND_NS)};
}

// Returns 0, or EINTR with what is left.
int sleep_until(Thread &thread, std::int64_t deadline_ns, timespec *left, const char *what) {
  pthread_testcancel();
  if (deadline_ns <= now_ns() || has_instant_sleep()) {
    yield(thread);
    return 0;
  }
  Outcome outcome;
  {
    Inside inside(thread);
    outcome = wait_at(thread, Kind::SLEEP, nullptr, deadline_ns, what, true);
  }
  if (outcome != Outcome::INTERRUPTED) return 0;
  pthread_testcancel();
  if (left != nullptr) *left = to_timespec(deadline_ns - now_ns());
  return EINTR;
}

std::string shown(const timespec &time) {
  char text[48];
  std::snprintf(text, sizeof text, "%ld.%09ld s", static_cast<long>(time.tv_sec), time.tv_nsec);
  return text;
}

std::int64_t look_at_clock(Thread &thread) {
  look(thread, 1);
  return shown_ns();
}

}  // namespace
}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT int clock_gettime(clockid_t clock, timespec *out) noexcept {
  Thread *thread = me();
  if (thread == nullptr && !linked()) return REAL(clock_gettime)(clock, out);
  timespec resolution;
  if (clock > CLOCK_TAI && REAL(clock_getres)(clock, &resolution) != 0) return -1;  // there is none
  const bool of_processor = clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID;
  if (of_processor && thread != nullptr) look(*thread, 1);
  *out = to_timespec(thread == nullptr || of_processor ? now_ns() : look_at_clock(*thread));
  RSLTRACE_NOTE(Source::CLOCK, "clock_gettime()", shown(*out));
  return 0;
}

// The clocks of std::chrono: the line that calls them is wanted, not that in the C++ library.
#define RSLTRACE_CHRONO(name, symbol, clock)                                       \
  RSLTRACE_EXPORT std::int64_t rsltrace_##name() noexcept __asm__(symbol);         \
  RSLTRACE_EXPORT std::int64_t rsltrace_##name() noexcept {                        \
    timespec now;                                                                  \
    clock_gettime(clock, &now);                                                    \
    RSLTRACE_NOTE(Source::CLOCK, "std::chrono::" #name "::now()", shown(now));     \
    return now.tv_sec * SECOND_NS + now.tv_nsec;                                   \
  }

RSLTRACE_CHRONO(system_clock, "_ZNSt6chrono3_V212system_clock3nowEv", CLOCK_REALTIME)
RSLTRACE_CHRONO(steady_clock, "_ZNSt6chrono3_V212steady_clock3nowEv", CLOCK_MONOTONIC)

RSLTRACE_EXPORT int gettimeofday(timeval *__restrict out, void *__restrict zone) noexcept {
  timespec now;
  if (!linked()) return REAL(gettimeofday)(out, zone);
  clock_gettime(CLOCK_REALTIME, &now);
  *out = {now.tv_sec, now.tv_nsec / 1000};
  RSLTRACE_NOTE(Source::CLOCK, "gettimeofday()", shown(now));
  return 0;
}

RSLTRACE_EXPORT time_t time(time_t *out) noexcept {
  if (!linked()) return REAL(time)(out);
  timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (out != nullptr) *out = now.tv_sec;
  RSLTRACE_NOTE(Source::CLOCK, "time()", std::to_string(now.tv_sec));
  return now.tv_sec;
}

RSLTRACE_EXPORT int ftime(timeb *out) {
  if (!linked()) return reinterpret_cast<int (*)(timeb *)>(real("ftime"))(out);  // REAL: its header warns of it
  timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  *out = {now.tv_sec, static_cast<unsigned short>(now.tv_nsec / 1'000'000), 0, 0};
  RSLTRACE_NOTE(Source::CLOCK, "ftime()", shown(now));
  return 0;
}

RSLTRACE_EXPORT int timespec_get(timespec *out, int base) noexcept {
  if (!linked() || base != TIME_UTC) return REAL(timespec_get)(out, base);
  clock_gettime(CLOCK_REALTIME, out);
  return base;
}

RSLTRACE_EXPORT clock_t clock() noexcept {
  if (!linked()) return REAL(clock)();
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec * CLOCKS_PER_SEC + now.tv_nsec / 1000;
}

RSLTRACE_EXPORT clock_t times(tms *out) noexcept {
  if (!linked()) return REAL(times)(out);
  const clock_t ticks = now_ns() / (SECOND_NS / sysconf(_SC_CLK_TCK));
  if (out != nullptr) *out = {ticks, 0, 0, 0};
  return ticks;
}

RSLTRACE_EXPORT int getrusage(__rusage_who_t who, rusage *out) noexcept {
  const int result = REAL(getrusage)(who, out);
  if (result != 0 || !linked()) return result;
  const long memory = out->ru_maxrss;
  *out = {};  // how often it waited, or was made to
  out->ru_maxrss = memory;
  if (who != RUSAGE_CHILDREN) out->ru_utime = {now_ns() / SECOND_NS, now_ns() % SECOND_NS / 1000};
  return result;
}

RSLTRACE_EXPORT int clock_nanosleep(clockid_t clock, int flags, const timespec *when, timespec *left) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(clock_nanosleep)(clock, flags, when, left);
  if (!valid(when) || (when->tv_sec < 0 && (flags & TIMER_ABSTIME) == 0)) return EINVAL;
  if ((flags & TIMER_ABSTIME) != 0) return sleep_until(*thread, deadline_of(*when), nullptr, "clock_nanosleep");
  return sleep_until(*thread, deadline_after(*when), left, "clock_nanosleep");
}

RSLTRACE_EXPORT int nanosleep(const timespec *span, timespec *left) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(nanosleep)(span, left);
  const bool good = valid(span) && span->tv_sec >= 0;
  const int failure = good ? sleep_until(*thread, deadline_after(*span), left, "nanosleep") : EINVAL;
  if (failure == 0) return 0;
  errno = failure;
  return -1;
}

RSLTRACE_EXPORT int usleep(useconds_t span) {
  const timespec time{span / 1'000'000, static_cast<long>(span % 1'000'000) * 1000};
  return nanosleep(&time, nullptr);
}

RSLTRACE_EXPORT unsigned sleep(unsigned seconds) {
  const timespec time{static_cast<time_t>(seconds), 0};
  timespec left{};
  if (nanosleep(&time, &left) == 0) return 0;
  return static_cast<unsigned>(left.tv_sec + (left.tv_nsec >= SECOND_NS / 2 ? 1 : 0));
}

RSLTRACE_EXPORT int sched_yield() noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sched_yield)();
  yield(*thread);
  return 0;
}

