// News of QoS: none so far, which client libraries take as "not supported by this middleware".
#include <rmw/event.h>

#include "rmw_common.h"

using namespace rsltrace;

RSLTRACE_EXPORT bool rmw_event_type_is_supported(rmw_event_type_t) { return false; }

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_event_init(rmw_event_t *, const rmw_publisher_t *publisher,
                                                   rmw_event_type_t) {
  RSLTRACE_OURS(publisher);
  return unsupported("QoS events of processes");
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_event_init(rmw_event_t *,
                                                      const rmw_subscription_t *subscription,
                                                      rmw_event_type_t) {
  RSLTRACE_OURS(subscription);
  return unsupported("QoS events of processes");
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_event(const rmw_event_t *, void *, bool *) {
  return unsupported("QoS events of processes");
}

RSLTRACE_EXPORT rmw_ret_t rmw_event_set_callback(rmw_event_t *, rmw_event_callback_t,
                                                 const void *) {
  return unsupported("QoS events of processes");
}
