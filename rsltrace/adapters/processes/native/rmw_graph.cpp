// Questions about the graph: the loop knows the answers.
#include <rmw/get_node_info_and_types.h>
#include <rmw/get_service_names_and_types.h>
#include <rmw/get_topic_endpoint_info.h>
#include <rmw/get_topic_names_and_types.h>
#include <rmw/names_and_types.h>
#include <rmw/topic_endpoint_info_array.h>

#include <set>

#include "rmw_common.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

// What is asked, as ../graph_answers.py reads it.
enum class About : std::uint32_t {
  NODES = 1,
  COUNT_PUBLISHERS,
  COUNT_SUBSCRIPTIONS,
  COUNT_CLIENTS,
  COUNT_SERVICES,
  TOPICS,
  SERVICES,
  PUBLISHERS_OF,
  SUBSCRIPTIONS_OF,
  SERVICES_OF,
  CLIENTS_OF,
  PUBLISHERS_ON,
  SUBSCRIPTIONS_ON,
};

// Who asks the same again, without having waited, waits for the graph to change.
void note_question(const Writer &question) {
  static std::set<std::vector<std::uint8_t>> asked;
  static std::uint64_t since;
  if (times_let_go() != since) asked.clear();
  since = times_let_go();
  if (asked.insert(question.bytes).second) return;
  if (Thread *thread = me()) look(*thread, LOOK_WEIGHT);
}

std::vector<std::uint8_t> ask_graph(About about, const std::string &one = "",
                                    const std::string &other = "") {
  Writer body;
  body.number(static_cast<std::uint32_t>(about));
  body.text(one);
  body.text(other);
  note_question(body);
  return ask(Say::GRAPH, body);
}

rmw_ret_t count(const rmw_node_t *node, About about, const char *name, size_t *result) {
  RSLTRACE_OURS(node);
  RSLTRACE_NOT_NULL(name);
  RSLTRACE_NOT_NULL(result);
  const auto answer = ask_graph(about, name);
  Reader reader(answer.data(), answer.size());
  *result = reader.number<std::uint32_t>();
  return RMW_RET_OK;
}

rmw_ret_t fill(Reader &reader, rcutils_string_array_t &array, rcutils_allocator_t &allocator) {
  const auto size = reader.number<std::uint32_t>();
  if (rcutils_string_array_init(&array, size, &allocator) != RCUTILS_RET_OK) {
    return RMW_RET_BAD_ALLOC;
  }
  for (std::uint32_t i = 0; i < size; i++) {
    array.data[i] = rcutils_strdup(reader.text().c_str(), allocator);
  }
  return RMW_RET_OK;
}

rmw_ret_t names_and_types(const rmw_node_t *node, rcutils_allocator_t *allocator,
                          rmw_names_and_types_t *result, About about, const char *name = "",
                          const char *space = "") {
  RSLTRACE_OURS(node);
  RSLTRACE_NOT_NULL(allocator);
  RSLTRACE_NOT_NULL(name);
  RSLTRACE_NOT_NULL(space);
  if (rmw_names_and_types_check_zero(result) != RMW_RET_OK) return RMW_RET_INVALID_ARGUMENT;
  const auto answer = ask_graph(about, name, space);
  Reader reader(answer.data(), answer.size());
  if (reader.number<std::uint32_t>() == 0) {
    RMW_SET_ERROR_MSG_WITH_FORMAT_STRING("there is no node %s in namespace %s", name, space);
    return RMW_RET_NODE_NAME_NON_EXISTENT;
  }
  const auto size = reader.number<std::uint32_t>();
  rmw_ret_t told = rmw_names_and_types_init(result, size, allocator);
  for (std::uint32_t i = 0; i < size && told == RMW_RET_OK; i++) {
    result->names.data[i] = rcutils_strdup(reader.text().c_str(), *allocator);
    told = fill(reader, result->types[i], *allocator);
  }
  return told;
}

rmw_ret_t read_info(Reader &reader, rmw_topic_endpoint_info_t &info, rmw_endpoint_type_t kind,
                    rcutils_allocator_t &allocator) {
  info = rmw_get_zero_initialized_topic_endpoint_info();
  info.node_name = rcutils_strdup(reader.text().c_str(), allocator);
  info.node_namespace = rcutils_strdup(reader.text().c_str(), allocator);
  info.topic_type = rcutils_strdup(reader.text().c_str(), allocator);
  info.endpoint_type = kind;
  reader.raw(info.endpoint_gid, sizeof info.endpoint_gid);
  info.qos_profile = read_qos(reader);
  const std::string hash = reader.text();
  if (!hash.empty()) {
    const auto told = rosidl_parse_type_hash_string(hash.c_str(), &info.topic_type_hash);
    if (told != RCUTILS_RET_OK) return RMW_RET_ERROR;
  }
  return RMW_RET_OK;
}

rmw_ret_t endpoints_on(const rmw_node_t *node, rcutils_allocator_t *allocator, const char *topic,
                       rmw_topic_endpoint_info_array_t *result, About about,
                       rmw_endpoint_type_t kind) {
  RSLTRACE_OURS(node);
  RSLTRACE_NOT_NULL(allocator);
  RSLTRACE_NOT_NULL(topic);
  if (rmw_topic_endpoint_info_array_check_zero(result) != RMW_RET_OK) {
    return RMW_RET_INVALID_ARGUMENT;
  }
  const auto answer = ask_graph(about, topic);
  Reader reader(answer.data(), answer.size());
  const auto size = reader.number<std::uint32_t>();
  rmw_ret_t told = rmw_topic_endpoint_info_array_init_with_size(result, size, allocator);
  for (std::uint32_t i = 0; i < size && told == RMW_RET_OK; i++) {
    told = read_info(reader, result->info_array[i], kind, *allocator);
  }
  return told;
}

rmw_ret_t nodes(const rmw_node_t *node, rcutils_string_array_t *names,
                rcutils_string_array_t *spaces, rcutils_string_array_t *enclaves) {
  RSLTRACE_OURS(node);
  RSLTRACE_NOT_NULL(names);
  RSLTRACE_NOT_NULL(spaces);
  rcutils_allocator_t allocator = rcutils_get_default_allocator();
  const auto answer = ask_graph(About::NODES);
  Reader reader(answer.data(), answer.size());
  rmw_ret_t told = fill(reader, *names, allocator);
  if (told == RMW_RET_OK) told = fill(reader, *spaces, allocator);
  if (told == RMW_RET_OK && enclaves != nullptr) told = fill(reader, *enclaves, allocator);
  return told;
}

}  // namespace

RSLTRACE_EXPORT rmw_ret_t rmw_get_node_names(const rmw_node_t *node, rcutils_string_array_t *names,
                                             rcutils_string_array_t *spaces) {
  return nodes(node, names, spaces, nullptr);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_node_names_with_enclaves(const rmw_node_t *node,
                                                           rcutils_string_array_t *names,
                                                           rcutils_string_array_t *spaces,
                                                           rcutils_string_array_t *enclaves) {
  RSLTRACE_NOT_NULL(enclaves);
  return nodes(node, names, spaces, enclaves);
}

RSLTRACE_EXPORT rmw_ret_t rmw_count_publishers(const rmw_node_t *node, const char *topic,
                                               size_t *result) {
  return count(node, About::COUNT_PUBLISHERS, topic, result);
}

RSLTRACE_EXPORT rmw_ret_t rmw_count_subscribers(const rmw_node_t *node, const char *topic,
                                                size_t *result) {
  return count(node, About::COUNT_SUBSCRIPTIONS, topic, result);
}

RSLTRACE_EXPORT rmw_ret_t rmw_count_clients(const rmw_node_t *node, const char *service,
                                            size_t *result) {
  return count(node, About::COUNT_CLIENTS, service, result);
}

RSLTRACE_EXPORT rmw_ret_t rmw_count_services(const rmw_node_t *node, const char *service,
                                             size_t *result) {
  return count(node, About::COUNT_SERVICES, service, result);
}

RSLTRACE_EXPORT rmw_ret_t rmw_service_server_is_available(const rmw_node_t *node,
                                                          const rmw_client_t *client,
                                                          bool *is_available) {
  RSLTRACE_OURS(client);
  RSLTRACE_NOT_NULL(is_available);
  size_t found = 0;
  const rmw_ret_t told = count(node, About::COUNT_SERVICES, client->service_name, &found);
  *is_available = found > 0;
  return told;
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_topic_names_and_types(const rmw_node_t *node,
                                                        rcutils_allocator_t *allocator, bool,
                                                        rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::TOPICS);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_service_names_and_types(const rmw_node_t *node,
                                                          rcutils_allocator_t *allocator,
                                                          rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::SERVICES);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_publisher_names_and_types_by_node(
    const rmw_node_t *node, rcutils_allocator_t *allocator, const char *name, const char *space,
    bool, rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::PUBLISHERS_OF, name, space);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_subscriber_names_and_types_by_node(
    const rmw_node_t *node, rcutils_allocator_t *allocator, const char *name, const char *space,
    bool, rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::SUBSCRIPTIONS_OF, name, space);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_service_names_and_types_by_node(
    const rmw_node_t *node, rcutils_allocator_t *allocator, const char *name, const char *space,
    rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::SERVICES_OF, name, space);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_client_names_and_types_by_node(
    const rmw_node_t *node, rcutils_allocator_t *allocator, const char *name, const char *space,
    rmw_names_and_types_t *result) {
  return names_and_types(node, allocator, result, About::CLIENTS_OF, name, space);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_publishers_info_by_topic(const rmw_node_t *node,
                                                           rcutils_allocator_t *allocator,
                                                           const char *topic, bool,
                                                           rmw_topic_endpoint_info_array_t *result) {
  return endpoints_on(node, allocator, topic, result, About::PUBLISHERS_ON,
                      RMW_ENDPOINT_PUBLISHER);
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_subscriptions_info_by_topic(
    const rmw_node_t *node, rcutils_allocator_t *allocator, const char *topic, bool,
    rmw_topic_endpoint_info_array_t *result) {
  return endpoints_on(node, allocator, topic, result, About::SUBSCRIPTIONS_ON,
                      RMW_ENDPOINT_SUBSCRIPTION);
}
