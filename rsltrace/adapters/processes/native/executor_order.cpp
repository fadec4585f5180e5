// rclcpp's executors keep what they wait for in containers that are ordered by addresses, and run what
// a wait has found in that order. So an executor gets to see one of each kind at a time; it looks anew
// before each callback, and says so to tracetools. (StaticSingleThreadedExecutor does not.) What belongs
// to a waitable is seen at once: an executor asks each waitable only once after a wait.
#include "executor_order.h"

#include <map>

#include "link.h"

namespace rsltrace {

namespace {

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

// Of one kind: what is still to be shown, the next at the end.
template <typename Item>
class Hidden {
 public:
  // Hide what has a place before `end`: what comes after belongs to waitables.
  void hide(Item **items, const std::vector<std::size_t> &ready, std::size_t end) {
    items_ = items;
    for (auto place = ready.rbegin(); place != ready.rend(); ++place) {
      if (*place >= end) continue;
      left_.push_back({*place, items[*place]});
      items[*place] = nullptr;
    }
    show_next();
  }
  // Show the next one if the last that was shown has been run.
  void show_next() {
    if (left_.empty() || (shown_ != nullptr && *shown_ != nullptr)) return;
    shown_ = items_ + left_.back().place;
    *shown_ = left_.back().item;
    left_.pop_back();
  }

 private:
  struct Left {
    std::size_t place;
    Item *item;
  };
  Item **items_ = nullptr;
  Item **shown_ = nullptr;
  std::vector<Left> left_;
};

struct Batch {
  Hidden<const rcl_subscription_t> subscriptions;
  Hidden<const rcl_timer_t> timers;
  Hidden<const rcl_client_t> clients;
  Hidden<const rcl_service_t> services;
};

// By the wait set: a callback may run an executor of its own.
thread_local std::map<const rcl_wait_set_t *, Batch> batches;
thread_local bool executor_waits = false;

// How many of each kind an executor has put into a wait set itself. Waitables, which come later, ask
// for the place that they get.
struct Direct {
  const rcl_wait_set_t *set = nullptr;
  std::size_t subscriptions = 0;
  std::size_t timers = 0;
  std::size_t clients = 0;
  std::size_t services = 0;
};
thread_local Direct direct;

Direct &direct_of(const rcl_wait_set_t *set) {
  if (direct.set != set) {
    direct = Direct{};
    direct.set = set;
  }
  return direct;
}

void forget(const rcl_wait_set_t *set) {
  batches.erase(set);
  if (direct.set == set) direct = Direct{};
}

template <typename Add, typename Item>
rcl_ret_t add(Add *real, rcl_wait_set_t *set, Item *item, std::size_t *index,
              std::size_t Direct::*count) {
  std::size_t place = 0;
  const rcl_ret_t result = real(set, item, &place);
  if (result != RCL_RET_OK) return result;
  if (index == nullptr) {
    direct_of(set).*count = place + 1;
  } else {
    *index = place;
  }
  return result;
}

}  // namespace

void show_in_order(const rcl_wait_set_t &set, const ReadyPlaces &ready) {
  if (!executor_waits) return;
  executor_waits = false;
  const Direct own = direct_of(&set);
  Batch &batch = batches[&set] = Batch{};
  batch.subscriptions.hide(set.subscriptions, ready.subscriptions, own.subscriptions);
  batch.timers.hide(set.timers, ready.timers, own.timers);
  batch.clients.hide(set.clients, ready.clients, own.clients);
  batch.services.hide(set.services, ready.services, own.services);
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT void ros_trace_rclcpp_executor_wait_for_work(int64_t) { executor_waits = true; }

RSLTRACE_EXPORT void ros_trace_rclcpp_executor_get_next_ready() {
  for (auto &[set, batch] : batches) {
    batch.subscriptions.show_next();
    batch.timers.show_next();
    batch.clients.show_next();
    batch.services.show_next();
  }
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_add_subscription(rcl_wait_set_t *set,
                                                        const rcl_subscription_t *item,
                                                        size_t *index) {
  static const auto real = rcl<decltype(rcl_wait_set_add_subscription)>("rcl_wait_set_add_subscription");
  return add(real, set, item, index, &Direct::subscriptions);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_add_timer(rcl_wait_set_t *set, const rcl_timer_t *item,
                                                 size_t *index) {
  static const auto real = rcl<decltype(rcl_wait_set_add_timer)>("rcl_wait_set_add_timer");
  return add(real, set, item, index, &Direct::timers);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_add_client(rcl_wait_set_t *set, const rcl_client_t *item,
                                                  size_t *index) {
  static const auto real = rcl<decltype(rcl_wait_set_add_client)>("rcl_wait_set_add_client");
  return add(real, set, item, index, &Direct::clients);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_add_service(rcl_wait_set_t *set, const rcl_service_t *item,
                                                   size_t *index) {
  static const auto real = rcl<decltype(rcl_wait_set_add_service)>("rcl_wait_set_add_service");
  return add(real, set, item, index, &Direct::services);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_clear(rcl_wait_set_t *set) {
  static const auto real = rcl<decltype(rcl_wait_set_clear)>("rcl_wait_set_clear");
  forget(set);
  return real(set);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_resize(rcl_wait_set_t *set, size_t subscriptions,
                                              size_t conditions, size_t timers, size_t clients,
                                              size_t services, size_t events) {
  static const auto real = rcl<decltype(rcl_wait_set_resize)>("rcl_wait_set_resize");
  forget(set);
  return real(set, subscriptions, conditions, timers, clients, services, events);
}

RSLTRACE_EXPORT rcl_ret_t rcl_wait_set_fini(rcl_wait_set_t *set) {
  static const auto real = rcl<decltype(rcl_wait_set_fini)>("rcl_wait_set_fini");
  forget(set);
  return real(set);
}
