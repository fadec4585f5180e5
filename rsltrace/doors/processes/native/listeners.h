// Callbacks of rmw: executors that do not wait for their entities are called when something is there.
#pragma once

#include <rmw/event_callback_type.h>

#include "endpoints.h"

namespace rsltrace {

// Call `callback` whenever something is handed over to an endpoint; null: no longer.
void listen_to(Endpoint &endpoint, rmw_event_callback_t callback, const void *data);
// The endpoint is gone.
void listen_no_more(std::uint32_t id);

}  // namespace rsltrace
