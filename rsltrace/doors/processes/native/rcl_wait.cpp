// Wait sets of rcl, with their timers: rmw_wait would only be told the shortest timeout.
#include <rcl/client.h>
#include <rcl/error_handling.h>
#include <rcl/guard_condition.h>
#include <rcl/service.h>
#include <rcl/subscription.h>
#include <rcl/wait.h>

#include "timers.h"
#include "waiting.h"

using namespace rsltrace;

namespace {

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

enum Kind : std::uint32_t { SUBSCRIPTION, SERVICE, CLIENT };

template <typename Item, typename Handle>
void add(Wanted &wanted, Item **items, std::size_t size, Kind kind, Handle rmw_handle) {
  for (std::size_t i = 0; i < size; i++) {
    if (items[i] == nullptr) continue;
    auto *handle = rmw_handle(items[i]);
    if (handle == nullptr) continue;
    wanted.receivers.push_back({static_cast<Endpoint *>(handle->data), i, kind});
  }
}

Wanted wanted_by(const rcl_wait_set_t &set, std::vector<std::size_t> &timer_places) {
  static const auto subscription =
      rcl<decltype(rcl_subscription_get_rmw_handle)>("rcl_subscription_get_rmw_handle");
  static const auto service =
      rcl<decltype(rcl_service_get_rmw_handle)>("rcl_service_get_rmw_handle");
  static const auto client = rcl<decltype(rcl_client_get_rmw_handle)>("rcl_client_get_rmw_handle");
  static const auto condition =
      rcl<decltype(rcl_guard_condition_get_rmw_handle)>("rcl_guard_condition_get_rmw_handle");
  Wanted wanted;
  add(wanted, set.subscriptions, set.size_of_subscriptions, SUBSCRIPTION, subscription);
  add(wanted, set.services, set.size_of_services, SERVICE, service);
  add(wanted, set.clients, set.size_of_clients, CLIENT, client);
  for (std::size_t i = 0; i < set.size_of_guard_conditions; i++) {
    if (set.guard_conditions[i] == nullptr) continue;
    const auto *handle = condition(set.guard_conditions[i]);
    if (handle != nullptr) wanted.conditions.push_back({&guard_condition(handle), i});
  }
  for (std::size_t i = 0; i < set.size_of_timers; i++) {
    const std::uint32_t id = set.timers[i] == nullptr ? 0 : timer_id(set.timers[i]);
    if (id == 0) continue;
    wanted.timers.push_back(id);
    timer_places.push_back(i);
  }
  return wanted;
}

constexpr std::size_t NONE = SIZE_MAX;

template <typename Item>
void keep_only(Item **items, std::size_t size, std::size_t place) {
  for (std::size_t i = 0; i < size; i++) {
    if (i != place) items[i] = nullptr;
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
  std::vector<std::size_t> timer_places;
  const Wanted wanted = wanted_by(*set, timer_places);
  const Found found = wait_for_one(wanted, timeout, "rcl_wait");
  const bool is_receiver = found.kind == Found::Kind::RECEIVER;
  const auto place = [&](std::uint32_t kind) {
    if (!is_receiver || wanted.receivers[found.index].kind != kind) return NONE;
    return wanted.receivers[found.index].place;
  };
  keep_only(set->subscriptions, set->size_of_subscriptions, place(SUBSCRIPTION));
  keep_only(set->services, set->size_of_services, place(SERVICE));
  keep_only(set->clients, set->size_of_clients, place(CLIENT));
  keep_only(set->guard_conditions, set->size_of_guard_conditions,
            found.kind == Found::Kind::CONDITION ? wanted.conditions[found.index].place : NONE);
  keep_only(set->timers, set->size_of_timers,
            found.kind == Found::Kind::TIMER ? timer_places[found.index] : NONE);
  keep_only(set->events, set->size_of_events, NONE);
  return found.kind == Found::Kind::NOTHING ? RCL_RET_TIMEOUT : RCL_RET_OK;
}
