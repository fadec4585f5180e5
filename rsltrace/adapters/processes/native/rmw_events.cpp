// QoS events: news of an endpoint's status, which are waited for and taken like messages.
#include <rmw/event.h>
#include <rmw/events_statuses/events_statuses.h>

#include "listeners.h"
#include "rmw_common.h"

using namespace rsltrace;

namespace {

// The name of a status, as ../../../middleware/qos/status.py has it.
const char *name_of(rmw_event_type_t type) {
  switch (type) {
    case RMW_EVENT_SUBSCRIPTION_MATCHED:
    case RMW_EVENT_PUBLICATION_MATCHED: return "matched";
    case RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE:
    case RMW_EVENT_OFFERED_QOS_INCOMPATIBLE: return "incompatible";
    case RMW_EVENT_REQUESTED_DEADLINE_MISSED:
    case RMW_EVENT_OFFERED_DEADLINE_MISSED: return "deadline_missed";
    case RMW_EVENT_MESSAGE_LOST: return "message_lost";
    case RMW_EVENT_LIVELINESS_CHANGED: return "liveliness_changed";
    case RMW_EVENT_LIVELINESS_LOST: return "liveliness_lost";
    case RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE:
    case RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE: return "incompatible_type";
    default: return nullptr;
  }
}

bool is_of_publishers(rmw_event_type_t type) {
  switch (type) {
    case RMW_EVENT_LIVELINESS_LOST:
    case RMW_EVENT_OFFERED_DEADLINE_MISSED:
    case RMW_EVENT_OFFERED_QOS_INCOMPATIBLE:
    case RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE:
    case RMW_EVENT_PUBLICATION_MATCHED: return true;
    default: return false;
  }
}

template <typename Handle>
rmw_ret_t init(rmw_event_t *event, const Handle *parent, rmw_event_type_t type, bool of_publisher) {
  RSLTRACE_NOT_NULL(event);
  RSLTRACE_OURS(parent);
  if (event->implementation_identifier != nullptr) {
    RMW_SET_ERROR_MSG("the event is initialized already");
    return RMW_RET_INVALID_ARGUMENT;
  }
  if (name_of(type) == nullptr || is_of_publishers(type) != of_publisher) {
    return unsupported("QoS events of this type");
  }
  auto *made = new Endpoint(new_id());
  remember(made);
  Writer body;
  body.number(made->id);
  body.number(static_cast<const Endpoint *>(parent->data)->id);
  body.text(name_of(type));
  say(Say::QOS_EVENT, body);
  event->implementation_identifier = IDENTIFIER;
  event->data = made;
  event->event_type = type;
  return RMW_RET_OK;
}

template <typename Status>
void count(Reader &reader, void *target) {
  auto &status = *static_cast<Status *>(target);
  status.total_count = static_cast<decltype(status.total_count)>(reader.number<std::int64_t>());
  status.total_count_change =
      static_cast<decltype(status.total_count_change)>(reader.number<std::int64_t>());
}

void count_peers(Reader &reader, void *target) {
  count<rmw_matched_status_t>(reader, target);
  auto &status = *static_cast<rmw_matched_status_t *>(target);
  status.current_count = static_cast<std::size_t>(reader.number<std::int64_t>());
  status.current_count_change = static_cast<std::int32_t>(reader.number<std::int64_t>());
}

void count_incompatible(Reader &reader, void *target) {
  count<rmw_qos_incompatible_event_status_t>(reader, target);
  static_cast<rmw_qos_incompatible_event_status_t *>(target)->last_policy_kind =
      static_cast<rmw_qos_policy_kind_t>(reader.number<std::int64_t>());
}

void count_alive(Reader &reader, void *target) {
  auto &status = *static_cast<rmw_liveliness_changed_status_t *>(target);
  for (std::int32_t *field : {&status.alive_count, &status.not_alive_count,
                              &status.alive_count_change, &status.not_alive_count_change})
    *field = static_cast<std::int32_t>(reader.number<std::int64_t>());
}

}  // namespace

RSLTRACE_EXPORT bool rmw_event_type_is_supported(rmw_event_type_t type) {
  return name_of(type) != nullptr;
}

RSLTRACE_EXPORT rmw_ret_t rmw_publisher_event_init(rmw_event_t *event,
                                                   const rmw_publisher_t *publisher,
                                                   rmw_event_type_t type) {
  return init(event, publisher, type, true);
}

RSLTRACE_EXPORT rmw_ret_t rmw_subscription_event_init(rmw_event_t *event,
                                                      const rmw_subscription_t *subscription,
                                                      rmw_event_type_t type) {
  return init(event, subscription, type, false);
}

RSLTRACE_EXPORT rmw_ret_t rmw_event_fini(rmw_event_t *event) {
  RSLTRACE_NOT_NULL(event);
  if (ours(event->implementation_identifier)) {
    auto *made = static_cast<Endpoint *>(event->data);
    forget(made->id);
    delete made;
  }
  *event = rmw_get_zero_initialized_event();
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_take_event(const rmw_event_t *event, void *status, bool *taken) {
  RSLTRACE_OURS(event);
  RSLTRACE_NOT_NULL(status);
  RSLTRACE_NOT_NULL(taken);
  Item item;
  *taken = take(*static_cast<Endpoint *>(event->data), item);
  if (!*taken) return RMW_RET_OK;
  Reader reader(item.data.data(), item.data.size());
  switch (event->event_type) {
    case RMW_EVENT_SUBSCRIPTION_MATCHED:
    case RMW_EVENT_PUBLICATION_MATCHED: count_peers(reader, status); break;
    case RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE:
    case RMW_EVENT_OFFERED_QOS_INCOMPATIBLE: count_incompatible(reader, status); break;
    case RMW_EVENT_LIVELINESS_CHANGED: count_alive(reader, status); break;
    case RMW_EVENT_MESSAGE_LOST: count<rmw_message_lost_status_t>(reader, status); break;
    case RMW_EVENT_LIVELINESS_LOST: count<rmw_liveliness_lost_status_t>(reader, status); break;
    case RMW_EVENT_REQUESTED_DEADLINE_MISSED:
    case RMW_EVENT_OFFERED_DEADLINE_MISSED:
      count<rmw_offered_deadline_missed_status_t>(reader, status);
      break;
    default: count<rmw_incompatible_type_status_t>(reader, status); break;
  }
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_event_set_callback(rmw_event_t *event, rmw_event_callback_t callback,
                                                 const void *data) {
  RSLTRACE_OURS(event);
  listen_to(*static_cast<Endpoint *>(event->data), callback, data);
  return RMW_RET_OK;
}
