#include "waiting.h"
#include "real.h"

#include <rmw/rmw.h>

#include <algorithm>
#include <list>
#include <unordered_set>

#include "rmw_common.h"
#include "scheduler.h"
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

Found find(const Wanted &wanted, const Ready &ready) {
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

// Who waits now, and for what.
struct Parked {
  const Wanted *wanted;
  Waiter *waiter;
};

std::list<Parked> &parked() {
  static auto *all = new std::list<Parked>;
  return *all;
}

// What was handed over without its turn having come, by number.
std::unordered_set<std::uint32_t> &without_turn() {
  static auto *all = new std::unordered_set<std::uint32_t>;
  return *all;
}

void forget_turns(const Wanted &wanted) {
  if (without_turn().empty()) return;
  for (const auto &one : wanted.receivers) without_turn().erase(one.endpoint->id);
  for (const auto id : wanted.timers) without_turn().erase(id);
}

// Which of some things the loop has ready, in the order in which it would run them.
std::vector<std::uint32_t> ask_ready(const std::vector<std::uint32_t> &ids) {
  Writer body;
  body.number(static_cast<std::uint32_t>(ids.size()));
  for (const auto id : ids) body.number(id);
  const auto answer = ask(Say::READY, body);
  Reader reader(answer.data(), answer.size());
  std::vector<std::uint32_t> ready(reader.number<std::uint32_t>());
  for (auto &id : ready) id = reader.number<std::uint32_t>();
  return ready;
}

// What the loop has ready, without asking it to let that run.
std::vector<Found> ready_there(const Wanted &wanted) {
  std::vector<std::uint32_t> ids;
  for (const auto &one : wanted.receivers) ids.push_back(one.endpoint->id);
  ids.insert(ids.end(), wanted.timers.begin(), wanted.timers.end());
  say_deadlines(wanted.timers);
  std::vector<Found> found;
  for (const std::uint32_t id : ask_ready(ids)) {
    found.push_back(find(wanted, {Wake::ENTITY, id}));
    if (found.back().kind == Found::Kind::NOTHING) found.back() = find(wanted, {Wake::TIMER, id});
  }
  return found;
}

Found without_its_turn(const Wanted &wanted, const Found &found) {
  without_turn().insert(found.kind == Found::Kind::TIMER
                            ? wanted.timers[found.index]
                            : wanted.receivers[found.index].endpoint->id);
  return found;
}

}  // namespace

std::vector<Found> ready_now(const Wanted &wanted) {
  forget_turns(wanted);
  std::vector<Found> found;
  for (std::size_t i = 0; i < wanted.conditions.size(); i++) {
    if (!wanted.conditions[i].condition->is_triggered) continue;
    wanted.conditions[i].condition->is_triggered = false;
    found.push_back({Found::Kind::CONDITION, i});
  }
  for (std::size_t i = 0; i < wanted.receivers.size(); i++) {
    if (!wanted.receivers[i].endpoint->inbox.empty()) found.push_back({Found::Kind::RECEIVER, i});
  }
  for (const Found &one : ready_there(wanted)) {
    const bool is_here = one.kind == Found::Kind::RECEIVER &&
                         !wanted.receivers[one.index].endpoint->inbox.empty();
    if (!is_here) found.push_back(without_its_turn(wanted, one));
  }
  return found;
}

void await_turn(Endpoint &endpoint) {
  if (without_turn().erase(endpoint.id) == 0 || ask_ready({endpoint.id}).empty()) return;
  Wanted wanted;
  wanted.receivers.push_back({&endpoint, 0, 0});
  wait_for_one(wanted, -1, "its turn");
}

void await_turn(std::uint32_t timer) {
  if (without_turn().erase(timer) == 0) return;
  say_deadlines({timer});
  if (ask_ready({timer}).empty()) return;
  Wanted wanted;
  wanted.timers.push_back(timer);
  wait_for_one(wanted, -1, "its turn");
}

Found wait_for_one(const Wanted &wanted, std::int64_t timeout_ns, const char *what) {
  const std::int64_t wait_ns = timeout_ns == 0 ? POLL_NS : timeout_ns;
  const bool for_ever = wait_ns < 0 || wait_ns > NEVER_NS - now_ns();
  const std::int64_t deadline_ns = for_ever ? NEVER_NS : now_ns() + wait_ns;
  forget_turns(wanted);
  while (true) {
    const Found here = ready_here(wanted);
    if (here.kind != Found::Kind::NOTHING) return here;
    Waiter waiter;
    waiter.thread = this_thread();
    waiter.deadline_ns = deadline_ns;
    waiter.what = what;
    say_passed();
    say_unseen();
    say_deadlines(wanted.timers);
    waiter.set = &numbered(wanted);
    for (const auto &one : wanted.conditions) one.condition->waiters.push_back(&waiter);
    parked().push_back({&wanted, &waiter});
    park(waiter);
    parked().remove_if([&](const Parked &one) { return one.waiter == &waiter; });
    for (const auto &one : wanted.conditions) remove(one.condition->waiters, &waiter);
    const Found there = find(wanted, waiter.ready);
    if (there.kind != Found::Kind::NOTHING) return there;
    if (now_ns() >= deadline_ns) return {};
  }
}

void wake_receivers(std::uint32_t endpoint) {
  for (const Parked &one : parked()) {
    if (find(*one.wanted, {Wake::ENTITY, endpoint}).kind == Found::Kind::NOTHING) continue;
    one.waiter->woken = true;
    one.waiter->ready = {Wake::ENTITY, endpoint};
  }
}

std::vector<Found> wait_for(const Wanted &wanted, std::int64_t timeout_ns, const char *what) {
  if (timeout_ns == 0) {
    std::vector<Found> found = ready_now(wanted);
    if (!found.empty()) {
      if (Thread *thread = me()) look(*thread, LOOK_WEIGHT);  // who takes nothing of it looks again
      return found;
    }
  }
  std::vector<Found> found = {wait_for_one(wanted, timeout_ns, what)};
  // rclpy finds what a guard condition has kept it from in its next wait, which it begins at once.
  if (timeout_ns > 0 && found[0].kind == Found::Kind::CONDITION && !has_python()) {
    const std::vector<Found> there = ready_there(wanted);
    if (!there.empty()) found.push_back(without_its_turn(wanted, there[0]));
  }
  return found;
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

void clear_others(void **items, std::size_t size, const std::vector<std::size_t> &kept) {
  for (std::size_t i = 0; i < size; i++) {
    if (std::find(kept.begin(), kept.end(), i) == kept.end()) items[i] = nullptr;
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
  const std::vector<Found> found = wait_for(wanted, timeout_ns, "rmw_wait");
  std::vector<std::size_t> kept[EVENT + 1];
  std::vector<std::size_t> kept_conditions;
  for (const Found &one : found) {
    if (one.kind == Found::Kind::RECEIVER)
      kept[wanted.receivers[one.index].kind].push_back(wanted.receivers[one.index].place);
    if (one.kind == Found::Kind::CONDITION)
      kept_conditions.push_back(wanted.conditions[one.index].place);
  }
  for (std::uint32_t i = 0; i < EVENT; i++) clear_others(arrays.items[i], arrays.sizes[i], kept[i]);
  if (events != nullptr) clear_others(events->events, events->event_count, kept[EVENT]);
  if (conditions != nullptr)
    clear_others(conditions->guard_conditions, conditions->guard_condition_count, kept_conditions);
  return found[0].kind == Found::Kind::NOTHING ? RMW_RET_TIMEOUT : RMW_RET_OK;
}
