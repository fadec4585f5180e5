#include "guard_conditions.h"

#include <map>

#include "rmw_common.h"
#include "threads.h"

namespace rsltrace {

namespace {

std::map<std::uint32_t, rmw_guard_condition_t *> &graph_conditions() {
  static auto *all = new std::map<std::uint32_t, rmw_guard_condition_t *>;
  return *all;
}

}  // namespace

void trigger(GuardCondition &condition) {
  condition.is_triggered = true;
  for (Waiter *waiter : condition.waiters) wake(*waiter);
}

rmw_guard_condition_t *graph_condition(std::uint32_t node) {
  auto *&found = graph_conditions()[node];
  if (found == nullptr) {
    found = new rmw_guard_condition_t{};
    found->implementation_identifier = IDENTIFIER;
    auto *condition = new GuardCondition;
    condition->is_of_graph = true;
    found->data = condition;
  }
  return found;
}

void forget_graph_condition(std::uint32_t node) {
  const auto found = graph_conditions().find(node);
  if (found == graph_conditions().end()) return;
  delete &guard_condition(found->second);
  delete found->second;
  graph_conditions().erase(found);
}

void graph_has_changed() {
  for (auto &[node, handle] : graph_conditions()) {
    GuardCondition &condition = guard_condition(handle);
    condition.is_triggered = true;
    for (Waiter *waiter : condition.waiters) {
      waiter->woken = true;
      waiter->ready = {Wake::GRAPH, GRAPH_ID};
    }
  }
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT rmw_guard_condition_t *rmw_create_guard_condition(rmw_context_t *context) {
  if (context == nullptr || !ours(context->implementation_identifier)) {
    RMW_SET_ERROR_MSG("a guard condition needs a context of this rmw");
    return nullptr;
  }
  auto *handle = new rmw_guard_condition_t{};
  handle->implementation_identifier = IDENTIFIER;
  handle->data = new GuardCondition;
  handle->context = context;
  return handle;
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_guard_condition(rmw_guard_condition_t *handle) {
  RSLTRACE_OURS(handle);
  delete &guard_condition(handle);
  delete handle;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_trigger_guard_condition(const rmw_guard_condition_t *handle) {
  RSLTRACE_OURS(handle);
  trigger(guard_condition(handle));
  return RMW_RET_OK;
}
