// Services and clients: requests and responses, with the number of the request and who asked.
#include <rmw/get_service_names_and_types.h>

#include "call_sites.h"
#include "listeners.h"
#include "rmw_common.h"

using namespace rsltrace;

namespace {

Endpoint &endpoint(const rmw_service_t *service) { return *static_cast<Endpoint *>(service->data); }

Endpoint &endpoint(const rmw_client_t *client) { return *static_cast<Endpoint *>(client->data); }

void describe(const Item &item, rmw_service_info_t &info) {
  info.source_timestamp = item.source_ns;
  info.received_timestamp = item.received_ns;
  info.request_id.sequence_number = static_cast<std::int64_t>(item.number);
  std::memcpy(info.request_id.writer_guid, item.gid, sizeof item.gid);
}

template <typename Handle>
Handle *create(Say kind, const rmw_node_t *node, const rosidl_service_type_support_t *type_support,
               const char *name, const rmw_qos_profile_t *qos) {
  if (node == nullptr || !ours(node->implementation_identifier) || name == nullptr ||
      qos == nullptr) {
    RMW_SET_ERROR_MSG("a service or client needs a node of this rmw, a name and a QoS");
    return nullptr;
  }
  ServiceCodec type;
  if (!type.find(type_support)) return nullptr;
  auto *made = new Endpoint(new_id());
  made->type = type.request;
  made->depth = depth_of(*qos);
  made->other_type = type.response;
  remember(made);
  Writer body;
  body.number(made->id);
  body.number(node_id(node));
  body.text(name);
  body.text(type.name);
  write_qos(body, *qos);
  say(kind, body);
  auto *handle = new Handle{};
  handle->implementation_identifier = IDENTIFIER;
  handle->data = made;
  handle->service_name = copied(name);
  return handle;
}

template <typename Handle>
rmw_ret_t destroy(rmw_node_t *node, Handle *handle) {
  RSLTRACE_OURS(node);
  RSLTRACE_OURS(handle);
  forget(endpoint(handle).id);
  delete &endpoint(handle);
  const rcutils_allocator_t allocator = rcutils_get_default_allocator();
  allocator.deallocate(const_cast<char *>(handle->service_name), allocator.state);
  delete handle;
  return RMW_RET_OK;
}

template <typename Handle>
rmw_ret_t qos_of(const Handle *handle, rmw_qos_profile_t *qos) {
  RSLTRACE_OURS(handle);
  RSLTRACE_NOT_NULL(qos);
  return actual_qos(endpoint(handle), qos);
}

template <typename Handle>
rmw_ret_t take_item(const Handle *handle, const MessageCodec &type, rmw_service_info_t *info,
                    void *message, bool *taken) {
  RSLTRACE_NOT_NULL(info);
  RSLTRACE_NOT_NULL(message);
  RSLTRACE_NOT_NULL(taken);
  Item item;
  *taken = false;
  if (!take(endpoint(handle), item)) return RMW_RET_OK;
  if (!type.deserialize(item.data.data(), item.data.size(), message)) return RMW_RET_ERROR;
  *taken = true;
  describe(item, *info);
  return RMW_RET_OK;
}

}  // namespace

RSLTRACE_EXPORT rmw_client_t *rmw_create_client(const rmw_node_t *node,
                                                const rosidl_service_type_support_t *type_support,
                                                const char *name, const rmw_qos_profile_t *qos) {
  return create<rmw_client_t>(Say::CLIENT, node, type_support, name, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_client(rmw_node_t *node, rmw_client_t *client) {
  return destroy(node, client);
}

RSLTRACE_EXPORT rmw_ret_t rmw_send_request(const rmw_client_t *client, const void *request,
                                           int64_t *sequence_id) {
  RSLTRACE_OURS(client);
  RSLTRACE_NOT_NULL(request);
  RSLTRACE_NOT_NULL(sequence_id);
  std::vector<std::uint8_t> data;
  Endpoint &from = endpoint(client);
  if (!from.type.serialize(request, data)) return RMW_RET_ERROR;
  *sequence_id = ++from.requests;  // the loop counts them in the same way
  note_sender(from.id);
  Writer body;
  body.number(from.id);
  body.raw(data.data(), data.size());
  say(Say::REQUEST, body);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_response(const rmw_client_t *client, rmw_service_info_t *info,
                                            void *response, bool *taken) {
  RSLTRACE_OURS(client);
  return take_item(client, endpoint(client).other_type, info, response, taken);
}

RSLTRACE_EXPORT rmw_ret_t rmw_client_request_publisher_get_actual_qos(const rmw_client_t *client,
                                                                      rmw_qos_profile_t *qos) {
  return qos_of(client, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_client_response_subscription_get_actual_qos(
    const rmw_client_t *client, rmw_qos_profile_t *qos) {
  return qos_of(client, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_gid_for_client(const rmw_client_t *client, rmw_gid_t *gid) {
  RSLTRACE_OURS(client);
  RSLTRACE_NOT_NULL(gid);
  gid->implementation_identifier = IDENTIFIER;
  read_gid(endpoint(client), gid->data);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_client_set_on_new_response_callback(rmw_client_t *client,
                                                                  rmw_event_callback_t callback,
                                                                  const void *data) {
  RSLTRACE_OURS(client);
  listen_to(endpoint(client), callback, data);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_service_t *rmw_create_service(const rmw_node_t *node,
                                                  const rosidl_service_type_support_t *type_support,
                                                  const char *name, const rmw_qos_profile_t *qos) {
  return create<rmw_service_t>(Say::SERVICE, node, type_support, name, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_destroy_service(rmw_node_t *node, rmw_service_t *service) {
  return destroy(node, service);
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_request(const rmw_service_t *service, rmw_service_info_t *info,
                                           void *request, bool *taken) {
  RSLTRACE_OURS(service);
  return take_item(service, endpoint(service).type, info, request, taken);
}

RSLTRACE_EXPORT rmw_ret_t rmw_send_response(const rmw_service_t *service, rmw_request_id_t *header,
                                            void *response) {
  RSLTRACE_OURS(service);
  RSLTRACE_NOT_NULL(header);
  RSLTRACE_NOT_NULL(response);
  std::vector<std::uint8_t> data;
  if (!endpoint(service).other_type.serialize(response, data)) return RMW_RET_ERROR;
  Writer body;
  body.number(endpoint(service).id);
  body.raw(header->writer_guid, RMW_GID_STORAGE_SIZE);
  body.number(header->sequence_number);
  body.raw(data.data(), data.size());
  say(Say::RESPONSE, body);
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_service_request_subscription_get_actual_qos(
    const rmw_service_t *service, rmw_qos_profile_t *qos) {
  return qos_of(service, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_service_response_publisher_get_actual_qos(
    const rmw_service_t *service, rmw_qos_profile_t *qos) {
  return qos_of(service, qos);
}

RSLTRACE_EXPORT rmw_ret_t rmw_service_set_on_new_request_callback(rmw_service_t *service,
                                                                  rmw_event_callback_t callback,
                                                                  const void *data) {
  RSLTRACE_OURS(service);
  listen_to(endpoint(service), callback, data);
  return RMW_RET_OK;
}
