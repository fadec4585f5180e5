// Names of callbacks, and whose timers are: rclcpp tells both to tracetools, rcl knows neither. And
// messages that stay in the process.
#include <rcl/node.h>
#include <rcl/publisher.h>
#include <rcl/service.h>
#include <rcl/subscription.h>

#include <unordered_map>

#include "call_sites.h"
#include "rmw_common.h"
#include "timers.h"

using namespace rsltrace;

namespace {

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

std::uint32_t subscription_id(const void *handle) {
  static const auto rmw_handle =
      rcl<decltype(rcl_subscription_get_rmw_handle)>("rcl_subscription_get_rmw_handle");
  const auto *found = rmw_handle(static_cast<const rcl_subscription_t *>(handle));
  return found == nullptr ? 0 : static_cast<Endpoint *>(found->data)->id;
}

std::uint32_t service_id(const void *handle) {
  static const auto rmw_handle =
      rcl<decltype(rcl_service_get_rmw_handle)>("rcl_service_get_rmw_handle");
  const auto *found = rmw_handle(static_cast<const rcl_service_t *>(handle));
  return found == nullptr ? 0 : static_cast<Endpoint *>(found->data)->id;
}

// The numbers of those whose rclcpp objects, or callbacks, are at an address.
using Owners = std::unordered_map<const void *, std::uint32_t>;

Owners &subscriptions() {
  static auto *all = new Owners;
  return *all;
}

Owners &callbacks() {
  static auto *all = new Owners;
  return *all;
}

void name(const void *callback, const char *symbol, const void *caller) {
  const auto found = callbacks().find(callback);
  if (found == callbacks().end() || symbol == nullptr || !linked()) return;
  Writer body;
  body.number(found->second);
  body.text(symbol);
  write_maker(body, caller);
  callbacks().erase(found);  // it is told once, and the address may become another's
  say(Say::CALLBACK, body);
}

}  // namespace

RSLTRACE_EXPORT void ros_trace_rclcpp_timer_callback_added(const void *timer, const void *callback) {
  const std::uint32_t id = timer_id(static_cast<const rcl_timer_t *>(timer));
  if (id != 0) callbacks()[callback] = id;
}

RSLTRACE_EXPORT void ros_trace_rclcpp_timer_link_node(const void *timer, const void *node) {
  static const auto rmw_handle = rcl<decltype(rcl_node_get_rmw_handle)>("rcl_node_get_rmw_handle");
  const std::uint32_t id = timer_id(static_cast<const rcl_timer_t *>(timer));
  const rmw_node_t *found = rmw_handle(static_cast<const rcl_node_t *>(node));
  if (id == 0 || found == nullptr || !linked()) return;
  Writer body;
  body.number(id);
  body.number(node_id(found));
  say(Say::TIMER_OF, body);
}

RSLTRACE_EXPORT void ros_trace_rclcpp_subscription_init(const void *handle,
                                                        const void *subscription) {
  if (!linked()) return;
  const std::uint32_t id = subscription_id(handle);
  if (id != 0) subscriptions()[subscription] = id;
}

RSLTRACE_EXPORT void ros_trace_rclcpp_subscription_callback_added(const void *subscription,
                                                                  const void *callback) {
  const auto found = subscriptions().find(subscription);
  if (found == subscriptions().end()) return;
  callbacks()[callback] = found->second;
  subscriptions().erase(found);
}

RSLTRACE_EXPORT void ros_trace_rclcpp_service_callback_added(const void *handle,
                                                             const void *callback) {
  if (!linked()) return;
  const std::uint32_t id = service_id(handle);
  if (id != 0) callbacks()[callback] = id;
}

RSLTRACE_EXPORT void ros_trace_rclcpp_intra_publish(const void *publisher, const void *) {
  static const auto rmw_handle =
      rcl<decltype(rcl_publisher_get_rmw_handle)>("rcl_publisher_get_rmw_handle");
  if (!linked()) return;
  const auto *found = rmw_handle(static_cast<const rcl_publisher_t *>(publisher));
  if (found != nullptr) stayed_here(*static_cast<Endpoint *>(found->data));
}

// rclcpp::NodeOptions::use_intra_process_comms() const: what stays in the process is in no trace.
RSLTRACE_EXPORT bool node_is_intra_process(const void *options) __asm__(
    "_ZNK6rclcpp11NodeOptions23use_intra_process_commsEv");
bool node_is_intra_process(const void *options) {
  static const auto asked = reinterpret_cast<bool (*)(const void *)>(
      original("librclcpp.so", "_ZNK6rclcpp11NodeOptions23use_intra_process_commsEv"));
  if (!asked(options)) return false;
  if (!linked() || has_intra_process()) return true;
  static bool is_told = false;
  if (!is_told)
    report(
        "use_intra_process_comms is off, so that all messages are in the trace; the entry's "
        "'intra_process: true' leaves it on");
  is_told = true;
  return false;
}

// rclcpp makes the text only if it is wanted.
RSLTRACE_EXPORT bool ros_trace_enabled_rclcpp_callback_register() { return linked(); }

RSLTRACE_EXPORT void ros_trace_do_rclcpp_callback_register(const void *callback,
                                                           const char *symbol) {
  name(callback, symbol, __builtin_return_address(0));
}

RSLTRACE_EXPORT void ros_trace_rclcpp_callback_register(const void *callback, const char *symbol) {
  name(callback, symbol, __builtin_return_address(0));
}
