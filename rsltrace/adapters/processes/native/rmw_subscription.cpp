// Subscriptions: what the loop hands over is taken from their inbox.
#include <rmw/dynamic_message_type_support.h>
#include <rmw/get_network_flow_endpoints.h>

#include "listeners.h"
#include "rmw_common.h"

using namespace rsltrace;

namespace {

Endpoint &endpoint(const rmw_subscription_t *subscription) {
  return *static_cast<Endpoint *>(subscription->data);
}

void describe(const Item &item, rmw_message_info_t &info) {
  info.source_timestamp = item.source_ns;
  info.received_timestamp = item.received_ns;
  info.publication_sequence_number = item.number;
  info.reception_sequence_number = item.reception;
  info.publisher_gid.implementation_identifier = IDENTIFIER;
  std::memcpy(info.publisher_gid.data, item.gid, sizeof item.gid);
  info.from_intra_process = false;
}

rmw_ret_t take_serialized(const rmw_subscription_t *subscription,
                          rmw_serialized_message_t *message, bool *taken,
                          rmw_message_info_t *info) {
  RSLTRACE_OURS(subscription);
  RSLTRACE_NOT_NULL(message);
  RSLTRACE_NOT_NULL(taken);
  Item item;
  *taken = take(endpoint(subscription), item);
  if (!*taken) return RMW_RET_OK;
  if (message->buffer_capacity < item.data.size()) {
    if (rmw_serialized_message_resize(message, item.data.size()) != RMW_RET_OK) {
      return RMW_RET_BAD_ALLOC;
    }
  }
  std::memcpy(message->buffer, item.data.data(), item.data.size());
  message->buffer_length = item.data.size();
  if (info != nullptr) describe(item, *info);
  return RMW_RET_OK;
}

}  // namespace

RSLTRACE_EXPORT rmw_subscription_t *rmw_create_subscription(
    const rmw_node_t *node, const rosidl_message_type_support_t *type_support, const char *topic,
    const rmw_qos_profile_t *qos, const rmw_subscription_options_t *options) {
  if (node == nullptr || !ours(node->implementation_identifier) || topic == nullptr ||
      qos == nullptr || options == nullptr) {
    RMW_SET_ERROR_MSG("a subscription needs a node of this rmw, a topic, a QoS and options");
    return nullptr;
  }
  if (options->require_unique_network_flow_endpoints ==
      RMW_UNIQUE_NETWORK_FLOW_ENDPOINTS_STRICTLY_REQUIRED) {
    unsupported("unique network flow endpoints");
    return nullptr;
  }
  MessageCodec type;
  if (!type.find(type_support)) return nullptr;
  auto *made = new Endpoint(new_id());
  made->type = type;
  made->depth = depth_of(*qos);
  remember(made);
  Writer body;
  body.number(made->id);
  body.number(node_id(node));
  body.text(topic);
  body.text(type.name());
  write_qos(body, *qos);
  body.number(static_cast<std::uint32_t>(options->ignore_local_publications));
  say(Say::SUBSCRIPTION, body);
  auto *subscription = new rmw_subscription_t{};
  subscription->implementation_identifier = IDENTIFIER;
  subscription->data = made;
  subscription->topic_name = copied(topic);
  subscription->options = *options;
  return subscription;
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_subscription(rmw_node_t *node,
                                                   rmw_subscription_t *subscription) {
  RSLTRACE_OURS(node);
  RSLTRACE_OURS(subscription);
  forget(endpoint(subscription).id);
  delete &endpoint(subscription);
  const rcutils_allocator_t allocator = rcutils_get_default_allocator();
  allocator.deallocate(const_cast<char *>(subscription->topic_name), allocator.state);
  delete subscription;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_with_info(const rmw_subscription_t *subscription, void *message,
                                             bool *taken, rmw_message_info_t *info,
                                             rmw_subscription_allocation_t *) {
  RSLTRACE_OURS(subscription);
  RSLTRACE_NOT_NULL(message);
  RSLTRACE_NOT_NULL(taken);
  Item item;
  *taken = false;
  if (!take(endpoint(subscription), item)) return RMW_RET_OK;
  if (!endpoint(subscription).type.deserialize(item.data.data(), item.data.size(), message)) {
    return RMW_RET_ERROR;
  }
  *taken = true;
  if (info != nullptr) describe(item, *info);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_take(const rmw_subscription_t *subscription, void *message,
                                   bool *taken, rmw_subscription_allocation_t *allocation) {
  return rmw_take_with_info(subscription, message, taken, nullptr, allocation);
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_sequence(const rmw_subscription_t *subscription, size_t count,
                                            rmw_message_sequence_t *messages,
                                            rmw_message_info_sequence_t *infos, size_t *taken,
                                            rmw_subscription_allocation_t *allocation) {
  RSLTRACE_OURS(subscription);
  RSLTRACE_NOT_NULL(messages);
  RSLTRACE_NOT_NULL(infos);
  RSLTRACE_NOT_NULL(taken);
  if (count == 0 || count > messages->capacity || count > infos->capacity) {
    RMW_SET_ERROR_MSG("a sequence must have room for the messages that are asked for");
    return RMW_RET_INVALID_ARGUMENT;
  }
  *taken = 0;
  rmw_ret_t result = RMW_RET_OK;
  for (bool more = true; more && *taken < count;) {
    result = rmw_take_with_info(subscription, messages->data[*taken], &more, &infos->data[*taken],
                                allocation);
    more = more && result == RMW_RET_OK;
    *taken += more ? 1 : 0;
  }
  messages->size = infos->size = *taken;
  return result;
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_serialized_message(const rmw_subscription_t *subscription,
                                                      rmw_serialized_message_t *message,
                                                      bool *taken,
                                                      rmw_subscription_allocation_t *) {
  return take_serialized(subscription, message, taken, nullptr);
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_serialized_message_with_info(
    const rmw_subscription_t *subscription, rmw_serialized_message_t *message, bool *taken,
    rmw_message_info_t *info, rmw_subscription_allocation_t *) {
  return take_serialized(subscription, message, taken, info);
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_get_actual_qos(const rmw_subscription_t *subscription,
                                                          rmw_qos_profile_t *qos) {
  RSLTRACE_OURS(subscription);
  RSLTRACE_NOT_NULL(qos);
  return actual_qos(endpoint(subscription), qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_count_matched_publishers(
    const rmw_subscription_t *subscription, size_t *count) {
  RSLTRACE_OURS(subscription);
  RSLTRACE_NOT_NULL(count);
  *count = matched(endpoint(subscription));
  return RMW_RET_OK;
}

// -- what no node has asked for so far ----------------------------------------------------------

RSLTRACE_EXPORT rmw_ret_t rmw_init_subscription_allocation(
    const rosidl_message_type_support_t *, const rosidl_runtime_c__Sequence__bound *,
    rmw_subscription_allocation_t *) {
  return unsupported("preallocated subscriptions");
}

RSLTRACE_EXPORT rmw_ret_t rmw_fini_subscription_allocation(rmw_subscription_allocation_t *) {
  return unsupported("preallocated subscriptions");
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_set_content_filter(
    rmw_subscription_t *, const rmw_subscription_content_filter_options_t *) {
  return unsupported("content filters");
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_get_content_filter(
    const rmw_subscription_t *, rcutils_allocator_t *, rmw_subscription_content_filter_options_t *) {
  return unsupported("content filters");
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_loaned_message(const rmw_subscription_t *, void **, bool *,
                                                  rmw_subscription_allocation_t *) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_loaned_message_with_info(const rmw_subscription_t *, void **,
                                                            bool *, rmw_message_info_t *,
                                                            rmw_subscription_allocation_t *) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_return_loaned_message_from_subscription(const rmw_subscription_t *,
                                                                      void *) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_get_network_flow_endpoints(
    const rmw_subscription_t *, rcutils_allocator_t *, rmw_network_flow_endpoint_array_t *) {
  return unsupported("network flow endpoints");
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_dynamic_message(const rmw_subscription_t *,
                                                   rosidl_dynamic_typesupport_dynamic_data_t *,
                                                   bool *, rmw_subscription_allocation_t *) {
  return unsupported("dynamic messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_dynamic_message_with_info(
    const rmw_subscription_t *, rosidl_dynamic_typesupport_dynamic_data_t *, bool *,
    rmw_message_info_t *, rmw_subscription_allocation_t *) {
  return unsupported("dynamic messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_serialization_support_init(
    const char *, rcutils_allocator_t *, rosidl_dynamic_typesupport_serialization_support_t *) {
  return unsupported("dynamic messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_set_on_new_message_callback(rmw_subscription_t *subscription,
                                                                       rmw_event_callback_t callback,
                                                                       const void *data) {
  RSLTRACE_OURS(subscription);
  listen_to(endpoint(subscription), callback, data);
  return RMW_RET_OK;
}
