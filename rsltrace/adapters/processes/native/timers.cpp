#include "timers.h"

#include <rcl/time.h>

#include <unordered_map>

#include "endpoints.h"
#include "guard_conditions.h"
#include "real.h"
#include "waiting.h"

namespace rsltrace {

namespace {

constexpr std::int64_t UNKNOWN_NS = -1;

struct Timer {
  const rcl_timer_t *handle;
  std::int64_t period_ns;
  std::int64_t made_ns;
  std::int64_t told_ns;  // the deadline that the loop knows
  bool was_called;
};

// The timer that the loop has let run, and whose callback may be called now.
std::uint32_t let_run = 0;

std::unordered_map<std::uint32_t, Timer> &timers() {
  static auto *all = new std::unordered_map<std::uint32_t, Timer>;
  return *all;
}

std::unordered_map<const rcl_timer_t *, std::uint32_t> &ids() {
  static auto *all = new std::unordered_map<const rcl_timer_t *, std::uint32_t>;
  return *all;
}

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

// When a timer is due; NEVER_NS if it is cancelled.
std::int64_t deadline_of(const Timer &timer) {
  static const auto is_canceled = rcl<decltype(rcl_timer_is_canceled)>("rcl_timer_is_canceled");
  static const auto until_next =
      rcl<decltype(rcl_timer_get_time_until_next_call)>("rcl_timer_get_time_until_next_call");
  bool canceled = false;
  std::int64_t left_ns = 0;
  if (is_canceled(timer.handle, &canceled) != RCL_RET_OK || canceled) return NEVER_NS;
  if (until_next(timer.handle, &left_ns) != RCL_RET_OK) return NEVER_NS;
  const std::int64_t deadline_ns = now_ns() + left_ns;
  // A period of zero is how executors poll: each look takes as long as a wait without a time.
  if (timer.period_ns == 0) return std::max(deadline_ns, timer.made_ns + 1'000'000);
  return deadline_ns;
}

// rclpy's executors make timers of their own for waits with a time, with clocks that are no node's.
bool may_be_an_executors(const rcl_clock_t &clock) {
  return has_python() && clock.type != RCL_ROS_TIME;
}

void made(const rcl_timer_t *handle, rcl_clock_t *clock, std::int64_t period_ns) {
  const std::uint32_t id = new_id();
  timers()[id] = {handle, period_ns, now_ns(), UNKNOWN_NS, false};
  ids()[handle] = id;
  Writer body;
  body.number(id);
  body.number(static_cast<std::uint32_t>(may_be_an_executors(*clock)));
  body.number(period_ns);
  say(Say::TIMER, body);
}

}  // namespace

std::uint32_t timer_id(const rcl_timer_t *timer) {
  const auto found = ids().find(timer);
  return found == ids().end() ? 0 : found->second;
}

void timer_may_run(std::uint32_t id) {
  const auto found = timers().find(id);
  if (found == timers().end()) return;
  Timer &timer = found->second;
  timer.was_called = false;
  let_run = id;
  // What the loop takes for its next deadline: on the grid it was started on, none of it twice.
  timer.told_ns += timer.period_ns;
  if (timer.told_ns > now_ns()) return;
  const std::int64_t late_ns = now_ns() - timer.told_ns;
  timer.told_ns = timer.period_ns == 0
                      ? now_ns()
                      : timer.told_ns + (1 + late_ns / timer.period_ns) * timer.period_ns;
}

void say_passed() {
  const auto found = timers().find(let_run);
  let_run = 0;
  if (found == timers().end() || found->second.was_called) return;
  Writer body;
  body.number(found->first);
  say(Say::TIMER_PASSED, body);
}

void say_deadlines(const std::vector<std::uint32_t> &wanted) {
  for (const std::uint32_t id : wanted) {
    Timer &timer = timers()[id];
    const std::int64_t deadline_ns = deadline_of(timer);
    if (deadline_ns == timer.told_ns) continue;
    timer.told_ns = deadline_ns;
    Writer body;
    body.number(id);
    body.number(deadline_ns);
    say(Say::TIMER_NEXT, body);
  }
}

}  // namespace rsltrace

using namespace rsltrace;

// The functions of librcl that a program calls: these stand before it, and call it.

RSLTRACE_EXPORT rcl_ret_t rcl_timer_init2(rcl_timer_t *timer, rcl_clock_t *clock,
                                          rcl_context_t *context, int64_t period,
                                          const rcl_timer_callback_t callback,
                                          rcl_allocator_t allocator, bool autostart) {
  static const auto real = rcl<decltype(rcl_timer_init2)>("rcl_timer_init2");
  const rcl_ret_t told = real(timer, clock, context, period, callback, allocator, autostart);
  if (told == RCL_RET_OK && linked()) made(timer, clock, period);
  return told;
}

RSLTRACE_EXPORT rcl_ret_t rcl_timer_init(rcl_timer_t *timer, rcl_clock_t *clock,
                                         rcl_context_t *context, int64_t period,
                                         const rcl_timer_callback_t callback,
                                         rcl_allocator_t allocator) {
  return rcl_timer_init2(timer, clock, context, period, callback, allocator, true);
}

RSLTRACE_EXPORT rcl_ret_t rcl_timer_fini(rcl_timer_t *timer) {
  static const auto real = rcl<decltype(rcl_timer_fini)>("rcl_timer_fini");
  const std::uint32_t id = timer_id(timer);
  if (id != 0) {
    timers().erase(id);
    ids().erase(timer);
    forget(id);
  }
  return real(timer);
}

namespace {

void note_called(const rcl_timer_t *timer) {
  await_turn(timer_id(timer));
  const auto found = timers().find(timer_id(timer));
  if (found != timers().end()) found->second.was_called = true;
}

}  // namespace

RSLTRACE_EXPORT rcl_ret_t rcl_timer_call(rcl_timer_t *timer) {
  static const auto real = rcl<decltype(rcl_timer_call)>("rcl_timer_call");
  note_called(timer);
  return real(timer);
}

RSLTRACE_EXPORT rcl_ret_t rcl_timer_call_with_info(rcl_timer_t *timer,
                                                   rcl_timer_call_info_t *info) {
  static const auto real = rcl<decltype(rcl_timer_call_with_info)>("rcl_timer_call_with_info");
  note_called(timer);
  return real(timer, info);
}

RSLTRACE_EXPORT rcl_ret_t rcl_timer_exchange_period(const rcl_timer_t *timer, int64_t period,
                                                    int64_t *old) {
  static const auto real = rcl<decltype(rcl_timer_exchange_period)>("rcl_timer_exchange_period");
  const rcl_ret_t told = real(timer, period, old);
  const std::uint32_t id = timer_id(timer);
  if (told == RCL_RET_OK && id != 0) timers()[id].period_ns = period;
  return told;
}
