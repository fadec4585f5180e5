// How a QoS profile is written, in the order of QosProfile.unpack on the other side.
#pragma once

#include <rmw/time.h>
#include <rmw/types.h>

#include "wire.h"

namespace rsltrace {

inline std::int64_t nanoseconds(const rmw_time_t &time) {
  return static_cast<std::int64_t>(rmw_time_total_nsec(time));
}

inline void write_qos(Writer &body, const rmw_qos_profile_t &qos) {
  body.number(static_cast<std::uint32_t>(qos.history));
  body.number(static_cast<std::uint64_t>(qos.depth));
  body.number(static_cast<std::uint32_t>(qos.reliability));
  body.number(static_cast<std::uint32_t>(qos.durability));
  body.number(nanoseconds(qos.deadline));
  body.number(nanoseconds(qos.lifespan));
  body.number(static_cast<std::uint32_t>(qos.liveliness));
  body.number(nanoseconds(qos.liveliness_lease_duration));
  body.number(static_cast<std::uint32_t>(qos.avoid_ros_namespace_conventions));
}

}  // namespace rsltrace
