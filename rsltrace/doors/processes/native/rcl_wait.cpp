// Wait sets of rcl, with their timers: rmw_wait would only be told the shortest timeout.
#include <dlfcn.h>
#include <rcl/client.h>
#include <rcl/error_handling.h>
#include <rcl/event.h>
#include <rcl/guard_condition.h>
#include <rcl/service.h>
#include <rcl/subscription.h>
#include <rcl/wait.h>

#include <algorithm>

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

// The place of a timer that is due by a clock which is set, NONE if there is none.
std::size_t due(const rcl_wait_set_t &set, const std::vector<std::size_t> &driven) {
  static const auto is_ready = rcl<decltype(rcl_timer_is_ready)>("rcl_timer_is_ready");
  for (const std::size_t place : driven) {
    bool ready = false;
    if (is_ready(set.timers[place], &ready) == RCL_RET_OK && ready) return place;
  }
  return NONE;
}

struct Outcome {
  Found found;
  std::size_t due = NONE;  // in the timers of the wait set
};

// Fills `waited`, anew whenever a clock is set: what drives it may have changed.
Outcome wait(const rcl_wait_set_t &set, Waited &waited, std::int64_t timeout_ns) {
  const bool for_ever = timeout_ns < 0 || timeout_ns > NEVER_NS - now_ns();
  const std::int64_t deadline_ns = for_ever ? NEVER_NS : now_ns() + timeout_ns;
  Outcome outcome;
  while (true) {
    waited = waited_by(set);
    outcome.due = due(set, waited.driven);
    if (outcome.due != NONE) return outcome;
    outcome.found = wait_for_one(waited.wanted, timeout_ns, "rcl_wait");
    const bool was_set = outcome.found.kind == Found::Kind::CONDITION &&
                         waited.wanted.conditions[outcome.found.index].place == NONE;
    if (!was_set) return outcome;
    if (!for_ever) timeout_ns = std::max<std::int64_t>(deadline_ns - now_ns(), 0);
  }
}

template <typename Item>
void keep_only(Item **items, std::size_t size, std::size_t place) {
  for (std::size_t i = 0; i < size; i++) {
    if (i != place) items[i] = nullptr;
  }
}

// With the one that was found all that are triggered, for rclpy: it looks at them in the order of
// their creation. (rclcpp goes by addresses, and gets one at a time.)
void keep_conditions(rcl_wait_set_t &set, const Wanted &wanted, const Found &found) {
  static const bool takes_all = dlsym(RTLD_DEFAULT, "Py_IsInitialized") != nullptr;
  std::vector<bool> kept(set.size_of_guard_conditions, false);
  if (found.kind == Found::Kind::CONDITION) kept[wanted.conditions[found.index].place] = true;
  for (const auto &one : wanted.conditions) {
    const bool is_there = found.kind == Found::Kind::CONDITION && takes_all && one.place != NONE &&
                          one.condition->is_triggered;
    if (!is_there) continue;
    one.condition->is_triggered = false;
    kept[one.place] = true;
  }
  for (std::size_t i = 0; i < kept.size(); i++) {
    if (!kept[i]) set.guard_conditions[i] = nullptr;
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
  const Wanted &wanted = waited.wanted;
  const Found &found = outcome.found;
  const bool is_receiver = found.kind == Found::Kind::RECEIVER;
  const auto place = [&](std::uint32_t kind) {
    if (!is_receiver || wanted.receivers[found.index].kind != kind) return NONE;
    return wanted.receivers[found.index].place;
  };
  keep_only(set->subscriptions, set->size_of_subscriptions, place(SUBSCRIPTION));
  keep_only(set->services, set->size_of_services, place(SERVICE));
  keep_only(set->clients, set->size_of_clients, place(CLIENT));
  keep_conditions(*set, wanted, found);
  keep_only(set->timers, set->size_of_timers,
            found.kind == Found::Kind::TIMER ? waited.timer_places[found.index] : outcome.due);
  keep_only(set->events, set->size_of_events, place(EVENT));
  return found.kind == Found::Kind::NOTHING && outcome.due == NONE ? RCL_RET_TIMEOUT : RCL_RET_OK;
}
