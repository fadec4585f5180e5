// Callbacks of rcl for what arrives, as EventsExecutor uses them: one is set, a number of messages or
// requests is sent to oneself, and another is set. How many the callbacks were called for in all goes
// out on /told, each time.
#include <rcl/error_handling.h>
#include <rcl/event.h>
#include <rcl/rcl.h>
#include <std_msgs/msg/u_int64.h>
#include <std_srvs/srv/trigger.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)

static rcl_publisher_t out, told;
static size_t counts[2];

static void on_arrival(const void *count, size_t number) { *(size_t *)count += number; }

static void pause_ms(long time_ms) {
  const struct timespec span = {0, time_ms * 1000000};
  nanosleep(&span, NULL);
}

static void publish(rcl_publisher_t *publisher, uint64_t number) {
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  message.data = number;
  CHECK(rcl_publish(publisher, &message, NULL));
}

static void say(size_t *count) {
  pause_ms(10);
  publish(&told, *count);
  *count = 0;
}

int main(int argc, const char **argv) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  rcl_context_t context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "listener", "", &context, &node_options));
  const rosidl_message_type_support_t *type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64);
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  out = rcl_get_zero_initialized_publisher();
  told = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&told, &node, type, "told", &publisher_options));
  rcl_subscription_options_t subscription_options = rcl_subscription_get_default_options();
  rcl_subscription_t in = rcl_get_zero_initialized_subscription();
  CHECK(rcl_subscription_init(&in, &node, type, "self", &subscription_options));

  // Those of before count once, whoever is told of them.
  CHECK(rcl_publisher_init(&out, &node, type, "self", &publisher_options));
  publish(&out, 1);
  CHECK(rcl_subscription_set_on_new_message_callback(&in, on_arrival, &counts[0]));
  say(&counts[0]);  // 1
  CHECK(rcl_subscription_set_on_new_message_callback(&in, on_arrival, &counts[1]));
  publish(&out, 2);
  say(&counts[0]);  // 0
  say(&counts[1]);  // 1
  CHECK(rcl_subscription_set_on_new_message_callback(&in, NULL, NULL));
  for (int i = 0; i < 3; i++) publish(&out, 3);
  say(&counts[1]);  // 0
  CHECK(rcl_subscription_set_on_new_message_callback(&in, on_arrival, &counts[0]));
  say(&counts[0]);  // 3

  // A server keeps as many requests as its depth says.
  rcl_service_options_t service_options = rcl_service_get_default_options();
  service_options.qos.depth = 2;
  rcl_service_t server = rcl_get_zero_initialized_service();
  const rosidl_service_type_support_t *trigger = ROSIDL_GET_SRV_TYPE_SUPPORT(std_srvs, srv, Trigger);
  CHECK(rcl_service_init(&server, &node, trigger, "ask", &service_options));
  rcl_client_options_t client_options = rcl_client_get_default_options();
  rcl_client_t client = rcl_get_zero_initialized_client();
  CHECK(rcl_client_init(&client, &node, trigger, "ask", &client_options));
  std_srvs__srv__Trigger_Request request;
  std_srvs__srv__Trigger_Request__init(&request);
  int64_t number;
  for (int i = 0; i < 3; i++) CHECK(rcl_send_request(&client, &request, &number));
  CHECK(rcl_service_set_on_new_request_callback(&server, on_arrival, &counts[0]));
  say(&counts[0]);  // 2
  for (int i = 0; i < 3; i++) CHECK(rcl_send_request(&client, &request, &number));
  say(&counts[0]);  // 2: it keeps no more of those that come at once
  size_t taken = 0;
  rmw_request_id_t id;
  while (rcl_take_request(&server, &id, &request) == RCL_RET_OK) taken++;
  publish(&told, taken);  // 2

  // Who waits for an event gets it, too, if another is called for it.
  rcl_event_t matched = rcl_get_zero_initialized_event();
  CHECK(rcl_publisher_event_init(&matched, &told, RCL_PUBLISHER_MATCHED));
  CHECK(rcl_event_set_callback(&matched, on_arrival, &counts[1]));
  rcl_subscription_t other = rcl_get_zero_initialized_subscription();
  CHECK(rcl_subscription_init(&other, &node, type, "told", &subscription_options));
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 0, 0, 0, 0, 0, 1, &context, allocator));
  CHECK(rcl_wait_set_add_event(&set, &matched, NULL));
  const bool found = rcl_wait(&set, RCL_MS_TO_NS(50)) == RCL_RET_OK && set.events[0] != NULL;
  say(&counts[1]);  // 1
  publish(&told, found);  // 1
  return 0;
}
