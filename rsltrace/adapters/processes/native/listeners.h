// Callbacks of rmw: executors that do not wait for their entities are called when something is there.
#pragma once

#include <rmw/event_callback_type.h>

#include "endpoints.h"

namespace rsltrace {

// Call `callback` whenever something is handed over to an endpoint, and now if there is something that
// nobody has been called for; null: no longer.
void listen_to(Endpoint &endpoint, rmw_event_callback_t callback, const void *data);
// Something has been handed over to an endpoint, whoever waited for it.
void has_arrived(std::uint32_t id);
// The endpoint is gone.
void listen_no_more(std::uint32_t id);

}  // namespace rsltrace
