// Looks 50 times a second what is there, on rcl alone, and takes all of it, as spin_some does: messages
// on /t0 to /t3, a timer of 20 ms, requests on /ask. What it has taken goes out on /seen.
//
// Usage: poller [what to do: "guard" triggers a guard condition before each look, "ask" has the
// requests come first, "leave" looks a hundred times and takes nothing, at one time]
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <std_msgs/msg/u_int64.h>
#include <std_srvs/srv/trigger.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define TOPICS 4
#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)

static rcl_publisher_t seen;
static rcl_subscription_t topics[TOPICS];
static rcl_service_t service;
static rcl_timer_t timer;

static void say(uint64_t number) {
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  message.data = number;
  CHECK(rcl_publish(&seen, &message, NULL));
}

static void on_timer(rcl_timer_t *which, int64_t since_last) {
  (void)which;
  (void)since_last;
  say(1000);
}

static void answer(void) {
  rmw_request_id_t id;
  std_srvs__srv__Trigger_Request request;
  std_srvs__srv__Trigger_Response response;
  std_srvs__srv__Trigger_Request__init(&request);
  std_srvs__srv__Trigger_Response__init(&response);
  if (rcl_take_request(&service, &id, &request) != RCL_RET_OK) return;
  say(2000);
  CHECK(rcl_send_response(&service, &id, &response));
}

int main(int argc, const char **argv) {
  const char *mode = argc > 1 ? argv[1] : "";
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  rcl_context_t context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "poller", "", &context, &node_options));
  const rosidl_message_type_support_t *type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64);
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  seen = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&seen, &node, type, "seen", &publisher_options));
  rcl_subscription_options_t subscription_options = rcl_subscription_get_default_options();
  subscription_options.qos.depth = 1;
  for (int i = 0; i < TOPICS; i++) {
    const char name[] = {'t', (char)('0' + i), '\0'};
    topics[i] = rcl_get_zero_initialized_subscription();
    CHECK(rcl_subscription_init(&topics[i], &node, type, name, &subscription_options));
  }
  service = rcl_get_zero_initialized_service();
  rcl_service_options_t service_options = rcl_service_get_default_options();
  CHECK(rcl_service_init(&service, &node, ROSIDL_GET_SRV_TYPE_SUPPORT(std_srvs, srv, Trigger),
                         "ask", &service_options));
  rcl_clock_t clock;
  CHECK(rcl_clock_init(RCL_STEADY_TIME, &clock, &allocator));
  timer = rcl_get_zero_initialized_timer();
  CHECK(rcl_timer_init2(&timer, &clock, &context, RCL_MS_TO_NS(20), on_timer, allocator, true));
  rcl_guard_condition_t guard = rcl_get_zero_initialized_guard_condition();
  CHECK(rcl_guard_condition_init(&guard, &context, rcl_guard_condition_get_default_options()));
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, TOPICS, 1, 1, 0, 1, 0, &context, allocator));
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  const struct timespec pause = {0, 20000000};
  while (rcl_context_is_valid(&context)) {
    nanosleep(&pause, NULL);
    if (strcmp(mode, "guard") == 0) CHECK(rcl_trigger_guard_condition(&guard));
    for (int looks = strcmp(mode, "leave") == 0 ? 1000 : 1; looks > 0; looks--) {
      CHECK(rcl_wait_set_clear(&set));
      for (int i = 0; i < TOPICS; i++) CHECK(rcl_wait_set_add_subscription(&set, &topics[i], NULL));
      CHECK(rcl_wait_set_add_guard_condition(&set, &guard, NULL));
      CHECK(rcl_wait_set_add_timer(&set, &timer, NULL));
      CHECK(rcl_wait_set_add_service(&set, &service, NULL));
      const rcl_ret_t told = rcl_wait(&set, 0);
      if (told != RCL_RET_TIMEOUT) CHECK(told);
    }
    if (strcmp(mode, "ask") == 0 && set.services[0] != NULL) answer();
    for (int i = TOPICS - 1; i >= 0; i--) {
      rmw_message_info_t info;
      if (set.subscriptions[i] == NULL) continue;
      if (rcl_take(&topics[i], &message, &info, NULL) == RCL_RET_OK)
        say((uint64_t)i * 100 + message.data);
    }
    if (set.timers[0] != NULL) CHECK(rcl_timer_call(&timer));
    if (strcmp(mode, "ask") != 0 && set.services[0] != NULL) answer();
  }
  return 0;
}
