// Nodes: participants of the graph.
#include <rmw/validate_namespace.h>
#include <rmw/validate_node_name.h>

#include "guard_conditions.h"
#include "rmw_common.h"

using namespace rsltrace;

namespace {

// A node's `data` is its number, so that it costs nothing to look it up.
void *as_data(std::uint32_t id) {
  return reinterpret_cast<void *>(static_cast<std::uintptr_t>(id));
}

bool are_valid(const char *name, const char *space) {
  int result = 0;
  if (rmw_validate_node_name(name, &result, nullptr) != RMW_RET_OK || result != 0) {
    RMW_SET_ERROR_MSG_WITH_FORMAT_STRING("invalid node name: %s",
                                         rmw_node_name_validation_result_string(result));
    return false;
  }
  if (rmw_validate_namespace(space, &result, nullptr) != RMW_RET_OK || result != 0) {
    RMW_SET_ERROR_MSG_WITH_FORMAT_STRING("invalid namespace: %s",
                                         rmw_namespace_validation_result_string(result));
    return false;
  }
  return true;
}

}  // namespace

RSLTRACE_EXPORT rmw_node_t *rmw_create_node(rmw_context_t *context, const char *name,
                                            const char *space) {
  if (context == nullptr || name == nullptr || space == nullptr ||
      !ours(context->implementation_identifier)) {
    RMW_SET_ERROR_MSG("a node needs a context of this rmw, a name and a namespace");
    return nullptr;
  }
  if (!are_valid(name, space)) return nullptr;
  auto *node = new rmw_node_t{};
  const auto id = new_id();
  node->implementation_identifier = IDENTIFIER;
  node->data = as_data(id);
  node->name = copied(name);
  node->namespace_ = copied(space);
  node->context = context;
  graph_condition(id);
  Writer body;
  body.number(id);
  body.text(name);
  body.text(space);
  body.text(context->options.enclave == nullptr ? "/" : context->options.enclave);
  say(Say::NODE, body);
  return node;
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_node(rmw_node_t *node) {
  RSLTRACE_OURS(node);
  forget_graph_condition(node_id(node));
  forget(node_id(node));
  const rcutils_allocator_t allocator = rcutils_get_default_allocator();
  allocator.deallocate(const_cast<char *>(node->name), allocator.state);
  allocator.deallocate(const_cast<char *>(node->namespace_), allocator.state);
  delete node;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT const rmw_guard_condition_t *rmw_node_get_graph_guard_condition(
    const rmw_node_t *node) {
  return graph_condition(node_id(node));
}

RSLTRACE_EXPORT rmw_ret_t rmw_set_log_severity(rmw_log_severity_t) { return RMW_RET_OK; }
