#include "waiting.h"

#include <rmw/rmw.h>

#include <algorithm>

#include "rmw_common.h"
#include "threads.h"
#include "timers.h"

namespace rsltrace {

namespace {

// Give the set of ids a number, the same as last time if it is the same set.
const WaitSet &numbered(const Wanted &wanted) {
  static std::uint32_t count = 0;
  static thread_local WaitSet last;
  static thread_local std::vector<std::uint32_t> ids;
  ids.clear();
  for (const auto &one : wanted.receivers) ids.push_back(one.endpoint->id);
  ids.insert(ids.end(), wanted.timers.begin(), wanted.timers.end());
  const auto of_graph = [](const auto &one) { return one.condition->is_of_graph; };
  if (std::any_of(wanted.conditions.begin(), wanted.conditions.end(), of_graph))
    ids.push_back(GRAPH_ID);
  if (last.set == 0 || ids != last.ids) {
    last.set = ++count;
    last.ids = ids;
    Writer body;
    body.number(this_thread());
    body.number(last.set);
    body.number(static_cast<std::uint32_t>(ids.size()));
    for (const auto id : ids) body.number(id);
    say(Say::WAIT_SET, body);
  }
  return last;
}

// What is ready without asking the loop.
Found ready_here(const Wanted &wanted) {
  for (std::size_t i = 0; i < wanted.conditions.size(); i++) {
    if (!wanted.conditions[i].condition->is_triggered) continue;
    wanted.conditions[i].condition->is_triggered = false;
    return {Found::Kind::CONDITION, i};
  }
  for (std::size_t i = 0; !wanted.only_new && i < wanted.receivers.size(); i++) {
    if (!wanted.receivers[i].endpoint->inbox.empty()) return {Found::Kind::RECEIVER, i};
  }
  return {};
}

Found ready_there(const Wanted &wanted, const Ready &ready) {
  for (std::size_t i = 0; i < wanted.receivers.size(); i++) {
    if (ready.kind == Wake::ENTITY && wanted.receivers[i].endpoint->id == ready.id) {
      return {Found::Kind::RECEIVER, i};
    }
  }
  for (std::size_t i = 0; i < wanted.timers.size(); i++) {
    if (ready.kind == Wake::TIMER && wanted.timers[i] == ready.id) return {Found::Kind::TIMER, i};
  }
  return {};
}

void remove(std::vector<Waiter *> &waiters, const Waiter *waiter) {
  waiters.erase(std::remove(waiters.begin(), waiters.end(), waiter), waiters.end());
}

}  // namespace

Found wait_for_one(const Wanted &wanted, std::int64_t timeout_ns, const char *what) {
  const std::int64_t wait_ns = timeout_ns == 0 ? POLL_NS : timeout_ns;
  const bool for_ever = wait_ns < 0 || wait_ns > NEVER_NS - now_ns();
  const std::int64_t deadline_ns = for_ever ? NEVER_NS : now_ns() + wait_ns;
  while (true) {
    const Found here = ready_here(wanted);
    if (here.kind != Found::Kind::NOTHING) return here;
    Waiter waiter;
    waiter.thread = this_thread();
    waiter.deadline_ns = deadline_ns;
    waiter.what = what;
    say_passed();
    say_deadlines(wanted.timers);
    waiter.set = &numbered(wanted);
    for (const auto &one : wanted.conditions) one.condition->waiters.push_back(&waiter);
    park(waiter);
    for (const auto &one : wanted.conditions) remove(one.condition->waiters, &waiter);
    const Found there = ready_there(wanted, waiter.ready);
    if (there.kind != Found::Kind::NOTHING) return there;
    if (now_ns() >= deadline_ns) return {};
  }
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT rmw_wait_set_t *rmw_create_wait_set(rmw_context_t *context, size_t) {
  if (context == nullptr || !ours(context->implementation_identifier)) {
    RMW_SET_ERROR_MSG("a wait set needs a context of this rmw");
    return nullptr;
  }
  auto *made = new rmw_wait_set_t{};
  made->implementation_identifier = IDENTIFIER;
  return made;
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_wait_set(rmw_wait_set_t *wait_set) {
  RSLTRACE_OURS(wait_set);
  delete wait_set;
  return RMW_RET_OK;
}

namespace {

constexpr std::uint32_t EVENT = 3;  // the kind after those of the arrays

// The arrays of a wait set of rmw; what is not ready becomes null in them.
struct Arrays {
  void **items[3];
  std::size_t sizes[3];
};

void clear_others(const Arrays &arrays, std::uint32_t kind, std::size_t place) {
  for (std::uint32_t i = 0; i < 3; i++) {
    for (std::size_t j = 0; j < arrays.sizes[i]; j++) {
      if (i != kind || j != place) arrays.items[i][j] = nullptr;
    }
  }
}

}  // namespace

RSLTRACE_EXPORT rmw_ret_t rmw_wait(rmw_subscriptions_t *subscriptions,
                                   rmw_guard_conditions_t *conditions, rmw_services_t *services,
                                   rmw_clients_t *clients, rmw_events_t *events,
                                   rmw_wait_set_t *wait_set, const rmw_time_t *timeout) {
  RSLTRACE_OURS(wait_set);
  const Arrays arrays = {
      {subscriptions != nullptr ? subscriptions->subscribers : nullptr,
       services != nullptr ? services->services : nullptr,
       clients != nullptr ? clients->clients : nullptr},
      {subscriptions != nullptr ? subscriptions->subscriber_count : 0,
       services != nullptr ? services->service_count : 0,
       clients != nullptr ? clients->client_count : 0}};
  Wanted wanted;
  for (std::uint32_t kind = 0; kind < 3; kind++) {
    for (std::size_t i = 0; i < arrays.sizes[kind]; i++) {
      void *item = arrays.items[kind][i];
      if (item != nullptr) wanted.receivers.push_back({static_cast<Endpoint *>(item), i, kind});
    }
  }
  for (std::size_t i = 0; events != nullptr && i < events->event_count; i++) {
    auto *item = static_cast<rmw_event_t *>(events->events[i]);
    if (item != nullptr) wanted.receivers.push_back({static_cast<Endpoint *>(item->data), i, EVENT});
  }
  for (std::size_t i = 0; conditions != nullptr && i < conditions->guard_condition_count; i++) {
    void *item = conditions->guard_conditions[i];
    if (item != nullptr) wanted.conditions.push_back({static_cast<GuardCondition *>(item), i});
  }
  const auto timeout_ns =
      timeout == nullptr ? -1 : static_cast<std::int64_t>(rmw_time_total_nsec(*timeout));
  const Found found = wait_for_one(wanted, timeout_ns, "rmw_wait");
  const bool is_receiver = found.kind == Found::Kind::RECEIVER;
  for (std::size_t i = 0; events != nullptr && i < events->event_count; i++) {
    const bool is_it = is_receiver && wanted.receivers[found.index].kind == EVENT &&
                       wanted.receivers[found.index].place == i;
    if (!is_it) events->events[i] = nullptr;
  }
  const bool is_condition = found.kind == Found::Kind::CONDITION;
  for (std::size_t i = 0; conditions != nullptr && i < conditions->guard_condition_count; i++) {
    if (!is_condition || wanted.conditions[found.index].place != i) {
      conditions->guard_conditions[i] = nullptr;
    }
  }
  if (is_receiver) {
    clear_others(arrays, wanted.receivers[found.index].kind, wanted.receivers[found.index].place);
  } else {
    clear_others(arrays, EVENT, 0);
  }
  return found.kind == Found::Kind::NOTHING ? RMW_RET_TIMEOUT : RMW_RET_OK;
}
