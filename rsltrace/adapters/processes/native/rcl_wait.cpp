// Wait sets of rcl, with their timers: rmw_wait would only be told the shortest timeout.
#include <rcl/client.h>
#include <rcl/error_handling.h>
#include <rcl/event.h>
#include <rcl/guard_condition.h>
#include <rcl/service.h>
#include <rcl/subscription.h>
#include <rcl/wait.h>

#include <algorithm>

#include "executor_order.h"
#include "real.h"
#include "ros_clocks.h"
#include "timers.h"
#include "waiting.h"

using namespace rsltrace;

namespace {

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

enum Kind : std::uint32_t { SUBSCRIPTION, SERVICE, CLIENT, EVENT };

template <typename Item, typename Handle>
void add(Wanted &wanted, Item **items, std::size_t size, Kind kind, Handle rmw_handle) {
  for (std::size_t i = 0; i < size; i++) {
    if (items[i] == nullptr) continue;
    auto *handle = rmw_handle(items[i]);
    if (handle == nullptr) continue;
    wanted.receivers.push_back({static_cast<Endpoint *>(handle->data), i, kind});
  }
}

constexpr std::size_t NONE = SIZE_MAX;

// What is waited for, and where timers have their places in the wait set. Those that a clock drives
// which is set by hand or by /clock are unknown to the loop: they are looked at when it is set.
struct Waited {
  Wanted wanted;
  std::vector<std::size_t> timer_places;
  std::vector<std::size_t> driven;
};

void add_timer(Waited &waited, const rcl_timer_t &timer, std::size_t place) {
  static const auto clock_of = rcl<decltype(rcl_timer_clock)>("rcl_timer_clock");
  static const auto condition =
      rcl<decltype(rcl_timer_get_guard_condition)>("rcl_timer_get_guard_condition");
  static const auto handle =
      rcl<decltype(rcl_guard_condition_get_rmw_handle)>("rcl_guard_condition_get_rmw_handle");
  const std::uint32_t id = timer_id(&timer);
  rcl_clock_t *clock = nullptr;
  if (id == 0 || clock_of(&timer, &clock) != RCL_RET_OK) return;
  if (may_be_driven(*clock)) {
    const auto *jumped = condition(&timer);
    if (jumped != nullptr)
      waited.wanted.conditions.push_back({&guard_condition(handle(jumped)), NONE});
  }
  if (is_driven(*clock)) {
    waited.driven.push_back(place);
  } else {
    waited.wanted.timers.push_back(id);
    waited.timer_places.push_back(place);
  }
}

Waited waited_by(const rcl_wait_set_t &set) {
  static const auto subscription =
      rcl<decltype(rcl_subscription_get_rmw_handle)>("rcl_subscription_get_rmw_handle");
  static const auto service =
      rcl<decltype(rcl_service_get_rmw_handle)>("rcl_service_get_rmw_handle");
  static const auto client = rcl<decltype(rcl_client_get_rmw_handle)>("rcl_client_get_rmw_handle");
  static const auto event = rcl<decltype(rcl_event_get_rmw_handle)>("rcl_event_get_rmw_handle");
  static const auto condition =
      rcl<decltype(rcl_guard_condition_get_rmw_handle)>("rcl_guard_condition_get_rmw_handle");
  Waited waited;
  Wanted &wanted = waited.wanted;
  add(wanted, set.subscriptions, set.size_of_subscriptions, SUBSCRIPTION, subscription);
  add(wanted, set.services, set.size_of_services, SERVICE, service);
  add(wanted, set.clients, set.size_of_clients, CLIENT, client);
  add(wanted, set.events, set.size_of_events, EVENT, event);
  for (std::size_t i = 0; i < set.size_of_guard_conditions; i++) {
    if (set.guard_conditions[i] == nullptr) continue;
    const auto *handle = condition(set.guard_conditions[i]);
    if (handle != nullptr) wanted.conditions.push_back({&guard_condition(handle), i});
  }
  for (std::size_t i = 0; i < set.size_of_timers; i++) {
    if (set.timers[i] != nullptr) add_timer(waited, *set.timers[i], i);
  }
  return waited;
}

// The places of the timers that are due by a clock which is set.
std::vector<std::size_t> due(const rcl_wait_set_t &set, const std::vector<std::size_t> &driven) {
  static const auto is_ready = rcl<decltype(rcl_timer_is_ready)>("rcl_timer_is_ready");
  std::vector<std::size_t> places;
  for (const std::size_t place : driven) {
    bool ready = false;
    if (is_ready(set.timers[place], &ready) == RCL_RET_OK && ready) places.push_back(place);
  }
  return places;
}

struct Outcome {
  std::vector<Found> found;
  std::vector<std::size_t> due;  // in the timers of the wait set
};

// Fills `waited`, anew whenever a clock is set: what drives it may have changed.
Outcome wait(const rcl_wait_set_t &set, Waited &waited, std::int64_t timeout_ns) {
  const bool for_ever = timeout_ns < 0 || timeout_ns > NEVER_NS - now_ns();
  const std::int64_t deadline_ns = for_ever ? NEVER_NS : now_ns() + timeout_ns;
  while (true) {
    waited = waited_by(set);
    const Wanted &wanted = waited.wanted;
    Outcome outcome;
    outcome.due = due(set, waited.driven);
    if (!outcome.due.empty()) {
      if (timeout_ns == 0) outcome.found = ready_now(wanted);
      else outcome.due.resize(1);
      return outcome;
    }
    outcome.found = wait_for(wanted, timeout_ns, "rcl_wait");
    const bool was_set = std::all_of(
        outcome.found.begin(), outcome.found.end(), [&](const Found &one) {
          return one.kind == Found::Kind::CONDITION && wanted.conditions[one.index].place == NONE;
        });
    if (!was_set) return outcome;
    if (!for_ever) timeout_ns = std::max<std::int64_t>(deadline_ns - now_ns(), 0);
  }
}

// The places of what stays in a wait set: what is ready.
struct Kept {
  std::vector<std::size_t> receivers[EVENT + 1];
  std::vector<std::size_t> conditions;
  std::vector<std::size_t> timers;
};

void keep(Kept &kept, const Waited &waited, const Found &found) {
  switch (found.kind) {
    case Found::Kind::RECEIVER: {
      const auto &one = waited.wanted.receivers[found.index];
      kept.receivers[one.kind].push_back(one.place);
      break;
    }
    case Found::Kind::CONDITION:
      kept.conditions.push_back(waited.wanted.conditions[found.index].place);
      break;
    case Found::Kind::TIMER: kept.timers.push_back(waited.timer_places[found.index]); break;
    case Found::Kind::NOTHING: break;
  }
}

template <typename Item>
void keep_only(Item **items, std::size_t size, const std::vector<std::size_t> &places) {
  for (std::size_t i = 0; i < size; i++) {
    if (std::find(places.begin(), places.end(), i) == places.end()) items[i] = nullptr;
  }
}

// With the one that was found all that are triggered, for rclpy: it looks at them in the order of
// their creation. (rclcpp goes by addresses, and gets one at a time, unless it only looks.)
void keep_triggered(Kept &kept, const Wanted &wanted) {
  for (const auto &one : wanted.conditions) {
    if (!has_python() || one.place == NONE || !one.condition->is_triggered) continue;
    one.condition->is_triggered = false;
    kept.conditions.push_back(one.place);
  }
}

}  // namespace

RSLTRACE_EXPORT rcl_ret_t rcl_wait(rcl_wait_set_t *set, int64_t timeout) {
  static const auto is_valid = rcl<decltype(rcl_wait_set_is_valid)>("rcl_wait_set_is_valid");
  if (set == nullptr) {
    RCL_SET_ERROR_MSG("wait_set argument is null");
    return RCL_RET_INVALID_ARGUMENT;
  }
  if (!is_valid(set)) {
    RCL_SET_ERROR_MSG("wait set is invalid");
    return RCL_RET_WAIT_SET_INVALID;
  }
  if (set->size_of_subscriptions + set->size_of_guard_conditions + set->size_of_timers +
          set->size_of_clients + set->size_of_services + set->size_of_events ==
      0) {
    RCL_SET_ERROR_MSG("wait set is empty");
    return RCL_RET_WAIT_SET_EMPTY;
  }
  Waited waited;
  const Outcome outcome = wait(*set, waited, timeout);
  Kept kept;
  for (const Found &one : outcome.found) keep(kept, waited, one);
  if (!kept.conditions.empty()) keep_triggered(kept, waited.wanted);
  kept.timers.insert(kept.timers.end(), outcome.due.begin(), outcome.due.end());
  keep_only(set->subscriptions, set->size_of_subscriptions, kept.receivers[SUBSCRIPTION]);
  keep_only(set->services, set->size_of_services, kept.receivers[SERVICE]);
  keep_only(set->clients, set->size_of_clients, kept.receivers[CLIENT]);
  keep_only(set->guard_conditions, set->size_of_guard_conditions, kept.conditions);
  keep_only(set->timers, set->size_of_timers, kept.timers);
  keep_only(set->events, set->size_of_events, kept.receivers[EVENT]);
  show_in_order(*set, {kept.receivers[SUBSCRIPTION], kept.timers, kept.receivers[CLIENT],
                       kept.receivers[SERVICE]});
  const bool is_timeout = outcome.found.size() == 1 && outcome.found[0].kind == Found::Kind::NOTHING;
  return is_timeout ? RCL_RET_TIMEOUT : RCL_RET_OK;
}
