// Whether a publisher and a subscription connect: the rules of DDS, what is offered against what is
// requested.
#include <rmw/qos_profiles.h>
#include <rmw/types.h>

#include <cstdio>

#include "rmw_common.h"

using namespace rsltrace;

namespace {

enum class Fit { YES, PERHAPS, NO };

// Of a policy with a weak and a strong value: a strong one must not be requested where the weak one
// is offered. The best that is available always fits, other values are settled later.
template <typename Policy>
Fit of_policy(Policy offered, Policy requested, Policy weak, Policy strong, Policy best) {
  if (offered == strong || requested == weak || offered == best || requested == best) return Fit::YES;
  return offered == weak && requested == strong ? Fit::NO : Fit::PERHAPS;
}

Fit of_time(const rmw_time_t &offered, const rmw_time_t &requested) {
  constexpr rmw_duration_t NONE = INT64_MAX - 1;  // "the best available", too
  const auto limit = [](const rmw_time_t &time) {
    const rmw_duration_t length = rmw_time_total_nsec(time);
    return length == 0 || length > NONE ? NONE : length;
  };
  return limit(offered) > limit(requested) ? Fit::NO : Fit::YES;
}

}  // namespace

RSLTRACE_EXPORT rmw_ret_t rmw_qos_profile_check_compatible(
    const rmw_qos_profile_t offered, const rmw_qos_profile_t requested,
    rmw_qos_compatibility_type_t *compatibility, char *reason, size_t reason_size) {
  RSLTRACE_NOT_NULL(compatibility);
  if (reason == nullptr && reason_size != 0) {
    RMW_SET_ERROR_MSG("a reason is asked for, but there is no room for it");
    return RMW_RET_INVALID_ARGUMENT;
  }
  const struct {
    const char *name;
    Fit fit;
  } policies[] = {
      {"reliability", of_policy(offered.reliability, requested.reliability,
                                RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT,
                                RMW_QOS_POLICY_RELIABILITY_RELIABLE,
                                RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE)},
      {"durability", of_policy(offered.durability, requested.durability,
                               RMW_QOS_POLICY_DURABILITY_VOLATILE,
                               RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL,
                               RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE)},
      {"deadline", of_time(offered.deadline, requested.deadline)},
      {"liveliness", of_policy(offered.liveliness, requested.liveliness,
                               RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
                               RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC,
                               RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE)},
      {"liveliness lease",
       of_time(offered.liveliness_lease_duration, requested.liveliness_lease_duration)},
  };
  std::string apart, doubtful;
  for (const auto &policy : policies) {
    const std::string name = policy.name;
    if (policy.fit == Fit::NO) apart += "ERROR: less " + name + " is offered than requested;";
    if (policy.fit == Fit::PERHAPS) doubtful += "WARNING: the " + name + " may not match;";
  }
  *compatibility = !apart.empty()      ? RMW_QOS_COMPATIBILITY_ERROR
                   : !doubtful.empty() ? RMW_QOS_COMPATIBILITY_WARNING
                                       : RMW_QOS_COMPATIBILITY_OK;
  if (reason_size > 0) std::snprintf(reason, reason_size, "%s", (apart + doubtful).c_str());
  return RMW_RET_OK;
}
