// Clocks of ROS show simulated time, whether or not a node has use_sim_time: the loop is where time
// comes from, so what /clock says changes nothing.
#include <rcl/time.h>
#include <rcutils/time.h>

#include <set>

#include "link.h"

using namespace rsltrace;

namespace {

rcutils_ret_t show(rcutils_time_point_value_t *now, const char *name) {
  if (linked()) {
    if (now == nullptr) return RCUTILS_RET_INVALID_ARGUMENT;
    *now = now_ns();
    return RCUTILS_RET_OK;
  }
  using Look = rcutils_ret_t(rcutils_time_point_value_t *);
  return reinterpret_cast<Look *>(original("librcutils.so", name))(now);
}

}  // namespace

RSLTRACE_EXPORT rcutils_ret_t rcutils_system_time_now(rcutils_time_point_value_t *now) {
  return show(now, "rcutils_system_time_now");
}

RSLTRACE_EXPORT rcutils_ret_t rcutils_steady_time_now(rcutils_time_point_value_t *now) {
  return show(now, "rcutils_steady_time_now");
}

namespace {

// Clocks that believe they are set by /clock. They are not: they show simulated time anyway.
std::set<const rcl_clock_t *> &set_by_topic() {
  static auto *all = new std::set<const rcl_clock_t *>;
  return *all;
}

rcl_ret_t check(const rcl_clock_t *clock) {
  return clock != nullptr && clock->type == RCL_ROS_TIME ? RCL_RET_OK : RCL_RET_INVALID_ARGUMENT;
}

}  // namespace

RSLTRACE_EXPORT rcl_ret_t rcl_enable_ros_time_override(rcl_clock_t *clock) {
  if (check(clock) == RCL_RET_OK) set_by_topic().insert(clock);
  return check(clock);
}

RSLTRACE_EXPORT rcl_ret_t rcl_disable_ros_time_override(rcl_clock_t *clock) {
  set_by_topic().erase(clock);
  return check(clock);
}

RSLTRACE_EXPORT rcl_ret_t rcl_is_enabled_ros_time_override(rcl_clock_t *clock, bool *is_enabled) {
  if (is_enabled == nullptr) return RCL_RET_INVALID_ARGUMENT;
  *is_enabled = set_by_topic().count(clock) > 0;
  return check(clock);
}

RSLTRACE_EXPORT rcl_ret_t rcl_set_ros_time_override(rcl_clock_t *clock, rcl_time_point_value_t) {
  return check(clock);
}

RSLTRACE_EXPORT rcl_ret_t rcl_clock_fini(rcl_clock_t *clock) {
  using Fini = rcl_ret_t(rcl_clock_t *);
  static const auto real = reinterpret_cast<Fini *>(original("librcl.so", "rcl_clock_fini"));
  set_by_topic().erase(clock);
  return real(clock);
}
