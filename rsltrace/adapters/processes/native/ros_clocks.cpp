// Clocks of ROS show simulated time, whether or not a node has use_sim_time: the loop is where time
// comes from, so what /clock says changes nothing, unless the job says that it does.
#include "ros_clocks.h"

#include <dlfcn.h>
#include <rcutils/time.h>

#include <map>
#include <set>

#include "link.h"

using namespace rsltrace;

namespace {

// Whether code is rcl's own, or ours on its behalf (rcl's last calls are jumps): its timers and log
// records go by true simulated time, even where the job has other clocks for nodes.
bool is_of_rcl(const void *code) {
  Dl_info where{};
  if (dladdr(code, &where) == 0 || where.dli_fname == nullptr) return false;
  const std::string path = where.dli_fname;
  const std::string file = path.substr(path.rfind('/') + 1);
  return file.rfind("librcl.", 0) == 0 || file.rfind("librcl_", 0) == 0 ||
         file.rfind("librcutils.", 0) == 0 || file.rfind("librmw_rsltrace", 0) == 0;
}

rcutils_ret_t show(rcutils_time_point_value_t *now, const char *name, const void *caller) {
  if (linked()) {
    if (now == nullptr) return RCUTILS_RET_INVALID_ARGUMENT;
    *now = !has_own_clocks() || is_of_rcl(caller) ? now_ns() : shown_ns();
    return RCUTILS_RET_OK;
  }
  using Look = rcutils_ret_t(rcutils_time_point_value_t *);
  return reinterpret_cast<Look *>(original("librcutils.so", name))(now);
}

}  // namespace

RSLTRACE_EXPORT rcutils_ret_t rcutils_system_time_now(rcutils_time_point_value_t *now) {
  return show(now, "rcutils_system_time_now", __builtin_return_address(0));
}

RSLTRACE_EXPORT rcutils_ret_t rcutils_steady_time_now(rcutils_time_point_value_t *now) {
  return show(now, "rcutils_steady_time_now", __builtin_return_address(0));
}

namespace {

// Clocks that believe they are set by /clock. They are not: they show simulated time anyway.
std::set<const rcl_clock_t *> &set_by_topic() {
  static auto *all = new std::set<const rcl_clock_t *>;
  return *all;
}

// Whether what sets a clock counts, for all that somebody has tried to set so far.
std::map<const rcl_clock_t *, bool> &asked_about() {
  static auto *all = new std::map<const rcl_clock_t *, bool>;
  return *all;
}

// The nodes that clocks are of, by their numbers, where the job has other clocks for nodes.
std::map<const rcl_clock_t *, std::uint32_t> &owners() {
  static auto *all = new std::map<const rcl_clock_t *, std::uint32_t>;
  return *all;
}

rcl_ret_t check(const rcl_clock_t *clock) {
  return clock != nullptr && clock->type == RCL_ROS_TIME ? RCL_RET_OK : RCL_RET_INVALID_ARGUMENT;
}

// Whether rcl is to do what it does natively with a clock that somebody sets.
bool is_rcls(const rcl_clock_t *clock) {
  if (check(clock) != RCL_RET_OK || !linked()) return true;
  const auto [found, is_new] = asked_about().insert({clock, false});
  if (is_new) {
    const auto answer = ask(Say::FOLLOWS, Writer());
    found->second = Reader(answer.data(), answer.size()).number<std::uint32_t>() != 0;
  }
  return found->second;
}

template <typename Function>
Function *rcl(const char *name) {
  return reinterpret_cast<Function *>(original("librcl.so", name));
}

}  // namespace

namespace rsltrace {

bool may_be_driven(const rcl_clock_t &clock) {
  const auto found = asked_about().find(&clock);
  return found != asked_about().end() && found->second;
}

bool is_driven(const rcl_clock_t &clock) {
  static const auto real =
      rcl<decltype(rcl_is_enabled_ros_time_override)>("rcl_is_enabled_ros_time_override");
  bool is_enabled = false;
  if (!may_be_driven(clock)) return false;
  return real(const_cast<rcl_clock_t *>(&clock), &is_enabled) == RCL_RET_OK && is_enabled;
}

}  // namespace rsltrace

RSLTRACE_EXPORT rcl_ret_t rcl_enable_ros_time_override(rcl_clock_t *clock) {
  static const auto real =
      rcl<decltype(rcl_enable_ros_time_override)>("rcl_enable_ros_time_override");
  if (is_rcls(clock)) return real(clock);
  set_by_topic().insert(clock);
  return RCL_RET_OK;
}

RSLTRACE_EXPORT rcl_ret_t rcl_disable_ros_time_override(rcl_clock_t *clock) {
  static const auto real =
      rcl<decltype(rcl_disable_ros_time_override)>("rcl_disable_ros_time_override");
  if (is_rcls(clock)) return real(clock);
  set_by_topic().erase(clock);
  return RCL_RET_OK;
}

RSLTRACE_EXPORT rcl_ret_t rcl_is_enabled_ros_time_override(rcl_clock_t *clock, bool *is_enabled) {
  static const auto real =
      rcl<decltype(rcl_is_enabled_ros_time_override)>("rcl_is_enabled_ros_time_override");
  if (is_enabled == nullptr || set_by_topic().count(clock) == 0) return real(clock, is_enabled);
  *is_enabled = true;
  return RCL_RET_OK;
}

RSLTRACE_EXPORT rcl_ret_t rcl_set_ros_time_override(rcl_clock_t *clock,
                                                    rcl_time_point_value_t time) {
  static const auto real = rcl<decltype(rcl_set_ros_time_override)>("rcl_set_ros_time_override");
  return is_rcls(clock) ? real(clock, time) : RCL_RET_OK;
}

RSLTRACE_EXPORT rcl_ret_t rcl_clock_fini(rcl_clock_t *clock) {
  static const auto real = rcl<decltype(rcl_clock_fini)>("rcl_clock_fini");
  set_by_topic().erase(clock);
  asked_about().erase(clock);
  owners().erase(clock);
  return real(clock);
}

RSLTRACE_EXPORT rcl_ret_t rcl_clock_init(rcl_clock_type_t type, rcl_clock_t *clock,
                                         rcl_allocator_t *allocator) {
  static const auto real = rcl<decltype(rcl_clock_init)>("rcl_clock_init");
  const rcl_ret_t told = real(type, clock, allocator);
  if (told == RCL_RET_OK && linked() && has_own_clocks()) owners()[clock] = owner_of_new_clock();
  return told;
}

RSLTRACE_EXPORT rcl_ret_t rcl_clock_get_now(rcl_clock_t *clock, rcl_time_point_value_t *now) {
  static const auto real = rcl<decltype(rcl_clock_get_now)>("rcl_clock_get_now");
  const rcl_ret_t told = real(clock, now);
  const bool as_it_is = told != RCL_RET_OK || !linked() || !has_own_clocks() ||
                        is_driven(*clock) || is_of_rcl(__builtin_return_address(0));
  if (as_it_is) return told;
  const auto owner = owners().find(clock);
  *now = shown_ns(owner == owners().end() ? 0 : owner->second, true);
  return told;
}
