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

// A thread that waits for all of them, as a middleware has one; it runs when nobody else can.
void *serve(void *) {
  for (;;) {
    Wanted wanted;
    wanted.only_new = true;
    wanted.conditions.push_back({&changed(), 0});
    for (const auto &[id, listener] : listeners())
      wanted.receivers.push_back({listener.endpoint, id, 0});
    const Found found = wait_for_one(wanted, -1, "what executors are to be told of");
    if (found.kind != Found::Kind::RECEIVER) continue;
    const auto told = listeners().find(static_cast<std::uint32_t>(wanted.receivers[found.index].place));
    if (told != listeners().end()) told->second.callback(told->second.data, 1);
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
  if (!endpoint.inbox.empty()) callback(data, endpoint.inbox.size());
}

void listen_no_more(std::uint32_t id) {
  if (listeners().erase(id) > 0) trigger(changed());
}

}  // namespace rsltrace
