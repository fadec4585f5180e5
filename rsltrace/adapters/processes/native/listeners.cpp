#include "listeners.h"

#include <pthread.h>

#include <map>

#include "waiting.h"

namespace rsltrace {

namespace {

struct Listener {
  Endpoint *endpoint;
  rmw_event_callback_t callback;
  const void *data;
};

std::map<std::uint32_t, Listener> &listeners() {
  static auto *all = new std::map<std::uint32_t, Listener>;
  return *all;
}

GuardCondition &changed() {
  static auto *condition = new GuardCondition;
  return *condition;
}

// Call a listener for what it has not been called for.
void report(Listener listener) {
  Endpoint &endpoint = *listener.endpoint;
  const std::size_t count = endpoint.inbox.size() - endpoint.reported;
  endpoint.reported = endpoint.inbox.size();
  if (count > 0) listener.callback(listener.data, count);
}

// A thread that waits for all of them, as a middleware has one; it runs when nobody else can.
void *serve(void *) {
  for (;;) {
    Wanted wanted;
    wanted.only_new = true;
    wanted.conditions.push_back({&changed(), 0});
    std::vector<std::uint32_t> ids;
    for (const auto &[id, listener] : listeners()) {
      wanted.receivers.push_back({listener.endpoint, id, 0});
      ids.push_back(id);
    }
    wait_for_one(wanted, -1, "what executors are to be told of");
    changed().is_triggered = false;
    for (const std::uint32_t id : ids) {  // a callback may change who listens
      const auto told = listeners().find(id);
      if (told != listeners().end()) report(told->second);
    }
  }
  return nullptr;
}

void start() {
  static bool is_running = false;
  if (is_running) return;
  is_running = true;
  pthread_t thread;
  if (pthread_create(&thread, nullptr, serve, nullptr) == 0) pthread_detach(thread);
}

}  // namespace

void listen_to(Endpoint &endpoint, rmw_event_callback_t callback, const void *data) {
  if (callback == nullptr) return listen_no_more(endpoint.id);
  if (!linked()) return;
  listeners()[endpoint.id] = {&endpoint, callback, data};
  start();
  trigger(changed());
  report(listeners()[endpoint.id]);
}

void has_arrived(std::uint32_t id) {
  if (listeners().count(id) == 0) return;
  changed().is_triggered = true;  // or it waits, and is woken
  wake_receivers(id);
}

void listen_no_more(std::uint32_t id) {
  if (listeners().erase(id) > 0) trigger(changed());
}

}  // namespace rsltrace
