// What the handles of rmw point to, and how what arrives gets there.
#pragma once

#include <rmw/types.h>

#include <cstdint>
#include <deque>
#include <vector>

#include "link.h"
#include "typesupport.h"

namespace rsltrace {

// The number of something in this process that the loop knows, in the order of creation.
std::uint32_t new_id();

// A message, request or response that has been handed over but not yet been taken.
struct Item {
  std::int64_t source_ns = 0;
  std::int64_t received_ns = 0;
  std::uint64_t number = 0;     // of the publication, or of the request
  std::uint64_t reception = 0;  // how many messages the subscription has been sent before
  std::uint8_t gid[RMW_GID_STORAGE_SIZE] = {};
  std::vector<std::uint8_t> data;
};

struct Endpoint {
  explicit Endpoint(std::uint32_t id_) : id(id_) {}
  std::uint32_t id;
  std::deque<Item> inbox;
  std::size_t depth = 0;     // how many items the inbox holds; 0: all
  std::size_t reported = 0;  // how many of them a listener has been called for (listeners.h)
  MessageCodec type;        // of a topic, or of requests
  MessageCodec other_type;  // of responses
  std::int64_t requests = 0;  // how many a client has sent
  bool is_unseen = false;     // the loop knows that it misses messages of this publisher
};

void remember(Endpoint *endpoint);
void forget(std::uint32_t id);
// How many items an endpoint of a QoS holds.
std::size_t depth_of(const rmw_qos_profile_t &qos);
// Put what the loop has sent into the endpoint's inbox; a full one drops its oldest.
void deliver(std::uint32_t id, Reader &reader);
// A publisher has given a message to others of this process: who waits then tells the loop of it,
// unless it is published, too.
void stayed_here(Endpoint &publisher);
void say_unseen();
// Take the oldest item: from the inbox, or from what waits in the loop. False: there is none.
bool take(Endpoint &endpoint, Item &item);
// How many endpoints it is connected to.
std::size_t matched(const Endpoint &endpoint);

// The loop expects a timer to move to its next deadline, and is told if it does not.
void timer_may_run(std::uint32_t id);

}  // namespace rsltrace
