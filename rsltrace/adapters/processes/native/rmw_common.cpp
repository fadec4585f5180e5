#include "rmw_common.h"

#include <cstdlib>

namespace rsltrace {

const char *const IDENTIFIER = "rmw_rsltrace";

namespace {

std::vector<std::uint8_t> ask_about(Say kind, const Endpoint &endpoint) {
  Writer body;
  body.number(endpoint.id);
  return ask(kind, body);
}

}  // namespace

rmw_qos_profile_t read_qos(Reader &reader) {
  rmw_qos_profile_t qos{};
  const auto time = [&reader] {
    return rmw_time_from_nsec(reader.number<std::int64_t>());
  };
  qos.history = static_cast<rmw_qos_history_policy_t>(reader.number<std::uint32_t>());
  qos.depth = reader.number<std::uint64_t>();
  qos.reliability = static_cast<rmw_qos_reliability_policy_t>(reader.number<std::uint32_t>());
  qos.durability = static_cast<rmw_qos_durability_policy_t>(reader.number<std::uint32_t>());
  qos.deadline = time();
  qos.lifespan = time();
  qos.liveliness = static_cast<rmw_qos_liveliness_policy_t>(reader.number<std::uint32_t>());
  qos.liveliness_lease_duration = time();
  qos.avoid_ros_namespace_conventions = reader.number<std::uint32_t>() != 0;
  return qos;
}

rmw_ret_t actual_qos(const Endpoint &endpoint, rmw_qos_profile_t *qos) {
  const auto answer = ask_about(Say::QOS, endpoint);
  Reader reader(answer.data(), answer.size());
  *qos = read_qos(reader);
  return RMW_RET_OK;
}

void read_gid(const Endpoint &endpoint, std::uint8_t *gid) {
  const auto answer = ask_about(Say::GID, endpoint);
  Reader reader(answer.data(), answer.size());
  reader.raw(gid, RMW_GID_STORAGE_SIZE);
}

rmw_ret_t unsupported(const char *what) {
  RMW_SET_ERROR_MSG_WITH_FORMAT_STRING("rsltrace does not simulate %s", what);
  return RMW_RET_UNSUPPORTED;
}

std::uint32_t node_id(const rmw_node_t *node) {
  return static_cast<std::uint32_t>(reinterpret_cast<std::uintptr_t>(node->data));
}

char *copied(const char *text) { return rcutils_strdup(text, rcutils_get_default_allocator()); }

}  // namespace rsltrace
