#include "endpoints.h"

#include <algorithm>
#include <unordered_map>

#include "listeners.h"
#include "waiting.h"

namespace rsltrace {

namespace {

std::unordered_map<std::uint32_t, Endpoint *> &endpoints() {
  static auto *all = new std::unordered_map<std::uint32_t, Endpoint *>;  // outlives finalizers
  return *all;
}

Item read_item(Reader &reader) {
  Item item;
  item.source_ns = reader.number<std::int64_t>();
  item.received_ns = reader.number<std::int64_t>();
  item.number = reader.number<std::uint64_t>();
  item.reception = reader.number<std::uint64_t>();
  reader.raw(item.gid, sizeof item.gid);
  item.data = reader.blob();
  return item;
}

void drop_oldest(Endpoint &endpoint) {
  endpoint.inbox.pop_front();
  if (endpoint.reported > 0) --endpoint.reported;
}

}  // namespace

std::uint32_t new_id() {
  static std::uint32_t count = 0;
  return ++count;
}

void remember(Endpoint *endpoint) { endpoints()[endpoint->id] = endpoint; }

void forget(std::uint32_t id) {
  endpoints().erase(id);
  listen_no_more(id);
  Writer body;
  body.number(id);
  if (linked()) say(Say::GONE, body);
}

std::size_t depth_of(const rmw_qos_profile_t &qos) {
  return qos.history == RMW_QOS_POLICY_HISTORY_KEEP_ALL ? 0 : std::max<std::size_t>(qos.depth, 1);
}

void deliver(std::uint32_t id, Reader &reader) {
  const auto found = endpoints().find(id);
  if (found == endpoints().end()) return;
  Endpoint &endpoint = *found->second;
  if (endpoint.depth != 0 && endpoint.inbox.size() == endpoint.depth) {
    drop_oldest(endpoint);
    Writer body;
    body.number(id);
    say(Say::DROPPED, body);
  }
  endpoint.inbox.push_back(read_item(reader));
  has_arrived(id);
}

bool take(Endpoint &endpoint, Item &item) {
  if (endpoint.inbox.empty()) await_turn(endpoint);
  if (!endpoint.inbox.empty()) {
    item = std::move(endpoint.inbox.front());
    drop_oldest(endpoint);
    return true;
  }
  if (!linked()) return false;
  Writer body;
  body.number(endpoint.id);
  const auto answer = ask(Say::TAKE, body);
  Reader reader(answer.data(), answer.size());
  if (reader.number<std::uint32_t>() == 0) return false;
  item = read_item(reader);
  return true;
}

std::size_t matched(const Endpoint &endpoint) {
  Writer body;
  body.number(endpoint.id);
  const auto answer = ask(Say::MATCHED, body);
  Reader reader(answer.data(), answer.size());
  return reader.number<std::uint32_t>();
}

}  // namespace rsltrace
