// Nodes: participants of the graph.
#include <rcl/remap.h>
#include <rcutils/strdup.h>
#include <rmw/validate_namespace.h>
#include <rmw/validate_node_name.h>
#include <sys/mman.h>
#include <unistd.h>

#include <cstring>
#include <string>

#include "entropy.h"
#include "guard_conditions.h"
#include "link.h"
#include "real.h"
#include "rmw_common.h"
#include "scheduler.h"

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

constexpr char DIGITS[] = "0123456789abcdef";
constexpr std::size_t LEAST_DIGITS = 8, MOST_DIGITS = 16;  // of an address

bool is_address(std::uintptr_t number) {
  const auto page = static_cast<std::uintptr_t>(sysconf(_SC_PAGESIZE));
  return msync(reinterpret_cast<void *>(number / page * page), page, MS_ASYNC) == 0;
}

// Draw other digits for the addresses in `name`, as many.
void hide_addresses(char *name) {
  static std::uint64_t state = seed() ^ 0x61646472;
  for (std::size_t length = 0; *name != '\0'; name += length == 0 ? 1 : length) {
    length = std::strspn(name, DIGITS);
    if (length < LEAST_DIGITS || length > MOST_DIGITS) continue;
    if (!is_address(std::strtoull(std::string(name, length).c_str(), nullptr, 16))) continue;
    std::uint64_t word = split_mix(state);
    for (std::size_t i = 0; i < length; ++i, word /= sizeof DIGITS - 1) name[i] = DIGITS[word % (sizeof DIGITS - 1)];
  }
}

}  // namespace

// rcl asks it for the name of each node; null says that the name stays.
RSLTRACE_EXPORT rcl_ret_t rcl_remap_node_name(const rcl_arguments_t *local, const rcl_arguments_t *global,
                                              const char *name, rcl_allocator_t allocator, char **out) {
  static const auto real =
      reinterpret_cast<decltype(&rcl_remap_node_name)>(original("librcl.so", "rcl_remap_node_name"));
  const rcl_ret_t result = real(local, global, name, allocator, out);
  if (me() == nullptr || result != RCL_RET_OK) return result;
  if (*out == nullptr) *out = rcutils_strdup(name, allocator);
  if (*out != nullptr) hide_addresses(*out);
  return result;
}

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
