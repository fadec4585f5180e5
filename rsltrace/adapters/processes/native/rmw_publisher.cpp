// Publishers: messages leave as canonical CDR.
#include <rmw/get_network_flow_endpoints.h>

#include <map>

#include "call_sites.h"
#include "rmw_common.h"

using namespace rsltrace;

namespace {

// By their numbers: what is said must not go by addresses.
std::map<std::uint32_t, Endpoint *> &kept_here() {
  static auto *all = new std::map<std::uint32_t, Endpoint *>;
  return *all;
}

Endpoint &endpoint(const rmw_publisher_t *publisher) {
  return *static_cast<Endpoint *>(publisher->data);
}

void publish(Endpoint &from, const std::uint8_t *data, std::size_t size) {
  if (!linked()) return;
  kept_here().erase(from.id);
  note_sender(from.id);
  Writer body;
  body.number(from.id);
  body.raw(data, size);
  say(Say::PUBLISH, body);
}

}  // namespace

void rsltrace::stayed_here(Endpoint &publisher) {
  if (!publisher.is_unseen) kept_here()[publisher.id] = &publisher;
}

void rsltrace::say_unseen() {
  for (const auto &[id, publisher] : kept_here()) {
    publisher->is_unseen = true;
    Writer body;
    body.number(id);
    say(Say::UNSEEN, body);
  }
  kept_here().clear();
}

RSLTRACE_EXPORT rmw_publisher_t *rmw_create_publisher(
    const rmw_node_t *node, const rosidl_message_type_support_t *type_support, const char *topic,
    const rmw_qos_profile_t *qos, const rmw_publisher_options_t *options) {
  if (node == nullptr || !ours(node->implementation_identifier) || topic == nullptr ||
      qos == nullptr || options == nullptr) {
    RMW_SET_ERROR_MSG("a publisher needs a node of this rmw, a topic, a QoS and options");
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
  remember(made);
  Writer body;
  body.number(made->id);
  body.number(node_id(node));
  body.text(topic);
  body.text(type.name());
  write_qos(body, *qos);
  say(Say::PUBLISHER, body);
  auto *publisher = new rmw_publisher_t{};
  publisher->implementation_identifier = IDENTIFIER;
  publisher->data = made;
  publisher->topic_name = copied(topic);
  publisher->options = *options;
  return publisher;
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_publisher(rmw_node_t *node, rmw_publisher_t *publisher) {
  RSLTRACE_OURS(node);
  RSLTRACE_OURS(publisher);
  kept_here().erase(endpoint(publisher).id);
  forget(endpoint(publisher).id);
  delete &endpoint(publisher);
  const rcutils_allocator_t allocator = rcutils_get_default_allocator();
  allocator.deallocate(const_cast<char *>(publisher->topic_name), allocator.state);
  delete publisher;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publish(const rmw_publisher_t *publisher, const void *message,
                                      rmw_publisher_allocation_t *) {
  RSLTRACE_OURS(publisher);
  RSLTRACE_NOT_NULL(message);
  static thread_local std::vector<std::uint8_t> data;
  if (!endpoint(publisher).type.serialize(message, data)) return RMW_RET_ERROR;
  publish(endpoint(publisher), data.data(), data.size());
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publish_serialized_message(const rmw_publisher_t *publisher,
                                                         const rmw_serialized_message_t *message,
                                                         rmw_publisher_allocation_t *) {
  RSLTRACE_OURS(publisher);
  RSLTRACE_NOT_NULL(message);
  publish(endpoint(publisher), message->buffer, message->buffer_length);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_get_actual_qos(const rmw_publisher_t *publisher,
                                                       rmw_qos_profile_t *qos) {
  RSLTRACE_OURS(publisher);
  RSLTRACE_NOT_NULL(qos);
  return actual_qos(endpoint(publisher), qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_count_matched_subscriptions(
    const rmw_publisher_t *publisher, size_t *count) {
  RSLTRACE_OURS(publisher);
  RSLTRACE_NOT_NULL(count);
  *count = matched(endpoint(publisher));
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_assert_liveliness(const rmw_publisher_t *publisher) {
  RSLTRACE_OURS(publisher);
  Writer body;
  body.number(endpoint(publisher).id);
  say(Say::ALIVE, body);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_wait_for_all_acked(const rmw_publisher_t *publisher,
                                                           rmw_time_t) {
  RSLTRACE_OURS(publisher);
  return RMW_RET_OK;  // all that was published is in the queues, or under way in the loop
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_gid_for_publisher(const rmw_publisher_t *publisher,
                                                    rmw_gid_t *gid) {
  RSLTRACE_OURS(publisher);
  RSLTRACE_NOT_NULL(gid);
  gid->implementation_identifier = IDENTIFIER;
  read_gid(endpoint(publisher), gid->data);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_compare_gids_equal(const rmw_gid_t *one, const rmw_gid_t *other,
                                                 bool *result) {
  RSLTRACE_OURS(one);
  RSLTRACE_OURS(other);
  RSLTRACE_NOT_NULL(result);
  *result = std::memcmp(one->data, other->data, RMW_GID_STORAGE_SIZE) == 0;
  return RMW_RET_OK;
}

// -- what no node has asked for so far ----------------------------------------------------------

RSLTRACE_EXPORT rmw_ret_t rmw_init_publisher_allocation(const rosidl_message_type_support_t *,
                                                        const rosidl_runtime_c__Sequence__bound *,
                                                        rmw_publisher_allocation_t *) {
  return unsupported("preallocated publishers");
}

RSLTRACE_EXPORT rmw_ret_t rmw_fini_publisher_allocation(rmw_publisher_allocation_t *) {
  return unsupported("preallocated publishers");
}

RSLTRACE_EXPORT rmw_ret_t rmw_borrow_loaned_message(const rmw_publisher_t *,
                                                    const rosidl_message_type_support_t *,
                                                    void **) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_return_loaned_message_from_publisher(const rmw_publisher_t *,
                                                                   void *) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_publish_loaned_message(const rmw_publisher_t *, void *,
                                                     rmw_publisher_allocation_t *) {
  return unsupported("loaned messages");
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_get_network_flow_endpoints(
    const rmw_publisher_t *, rcutils_allocator_t *, rmw_network_flow_endpoint_array_t *) {
  return unsupported("network flow endpoints");
}
