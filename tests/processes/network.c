// One node of RSLCPP's determinism network on rcl's C API: network a|b|c|d|monitor.
//
// As examples/rslcpp_determinism/nodes.py: every callback mixes its seed, the time and its input
// into a state, so the states at the end depend on the order of every single callback.
#include <rcl/error_handling.h>
#include <rcl/logging.h>
#include <rcl/logging_rosout.h>
#include <rcl/rcl.h>
#include <rcutils/logging_macros.h>
#include <rosidl_runtime_c/string_functions.h>
#include <signal.h>
#include <std_msgs/msg/u_int64.h>
#include <std_msgs/msg/u_int8.h>
#include <std_srvs/srv/trigger.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)
#define MAX 4

typedef struct {
  rcl_subscription_t handle;
  uint64_t seed;
  rcl_publisher_t *target;
  bool asks;
} Input;

typedef struct {
  rcl_timer_t handle;
  uint64_t seed;
  rcl_publisher_t *target;
} Ticker;

static rcl_allocator_t allocator;
static rcl_context_t context;
static rcl_node_t node;
static rcl_clock_t ros_clock;
static rcl_publisher_t publishers[MAX];
static Input inputs[MAX];
static Ticker tickers[MAX];
static rcl_client_t client;
static rcl_service_t service;
static rcl_guard_condition_t ended;
static size_t publisher_count, input_count, ticker_count;
static bool is_client, is_service, is_monitor;
static volatile sig_atomic_t is_over = 0;
static uint64_t state;
static int64_t first_tick_ns = -1;

static uint64_t mix(uint64_t h1, uint64_t h2) {
  const uint64_t k = 0x9ddfea08eb382d69ULL;
  uint64_t a = (h1 ^ h2) * k;
  a ^= a >> 47;
  uint64_t b = (h2 ^ a) * k;
  b ^= b >> 47;
  uint64_t x = b * k + 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

static int64_t now_ns(void) {
  rcl_time_point_value_t now;
  CHECK(rcl_clock_get_now(&ros_clock, &now));
  return now;
}

static uint64_t step(uint64_t seed, const uint64_t *input) {
  state = mix(mix(state, seed), (uint64_t)now_ns());
  if (input != NULL) state = mix(state, *input);
  return state;
}

static void send(rcl_publisher_t *target, uint64_t value) {
  std_msgs__msg__UInt64 message = {value};
  if (target != NULL) CHECK(rcl_publish(target, &message, NULL));
}

static rcl_publisher_t *publisher(const char *topic) {
  rcl_publisher_options_t options = rcl_publisher_get_default_options();
  options.qos.depth = 1;
  rcl_publisher_t *made = &publishers[publisher_count++];
  *made = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(made, &node,
                           is_monitor ? ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt8)
                                      : ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64),
                           topic, &options));
  return made;
}

static void subscribe(const char *topic, uint64_t seed, rcl_publisher_t *target, bool asks) {
  rcl_subscription_options_t options = rcl_subscription_get_default_options();
  options.qos.depth = 1;
  Input *made = &inputs[input_count++];
  *made = (Input){rcl_get_zero_initialized_subscription(), seed, target, asks};
  CHECK(rcl_subscription_init(&made->handle, &node,
                              ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64), topic,
                              &options));
}

static void on_timer(rcl_timer_t *timer, int64_t since_last) {
  (void)since_last;
  for (size_t i = 0; i < ticker_count; i++) {
    if (&tickers[i].handle == timer && !is_monitor) {
      send(tickers[i].target, step(tickers[i].seed, NULL));
    }
  }
  if (!is_monitor) return;
  if (first_tick_ns < 0) first_tick_ns = now_ns();
  if (now_ns() - first_tick_ns >= 100 * 1000000000LL) {
    std_msgs__msg__UInt8 message = {0};
    CHECK(rcl_publish(&publishers[0], &message, NULL));
  }
}

static void tick(int64_t period_ms, uint64_t seed, rcl_publisher_t *target) {
  Ticker *made = &tickers[ticker_count++];
  *made = (Ticker){rcl_get_zero_initialized_timer(), seed, target};
  CHECK(rcl_timer_init2(&made->handle, &ros_clock, &context, RCL_MS_TO_NS(period_ms), on_timer,
                        allocator, true));
}

static void make_node(const char *name) {
  const rosidl_service_type_support_t *trigger =
      ROSIDL_GET_SRV_TYPE_SUPPORT(std_srvs, srv, Trigger);
  switch (name[0]) {
    case 'a': {
      state = 55272744;
      rcl_publisher_t *t1 = publisher("/t1");
      rcl_publisher_t *t2 = publisher("/t2");
      tick(100, 11162456753, t1);
      tick(50, 11151784617, t2);
      subscribe("/t5", 22255799981, NULL, false);
      break;
    }
    case 'b': {
      state = 34983402;
      rcl_publisher_t *t3 = publisher("/t3");
      rcl_publisher_t *t5 = publisher("/t5");
      subscribe("/t2", 22229447589, t3, false);
      tick(40, 11111071799, t5);
      break;
    }
    case 'c': {
      state = 87997653;
      rcl_publisher_t *t4 = publisher("/t4");
      is_client = true;
      rcl_client_options_t options = rcl_client_get_default_options();
      client = rcl_get_zero_initialized_client();
      CHECK(rcl_client_init(&client, &node, trigger, "/s1", &options));
      subscribe("/t1", 22295316797, NULL, true);
      subscribe("/t3", 22227118361, t4, false);
      break;
    }
    case 'd': {
      state = 11380831;
      rcl_publisher_t *t5 = publisher("/t5");
      subscribe("/t4", 2227672095, t5, false);
      is_service = true;
      rcl_service_options_t options = rcl_service_get_default_options();
      service = rcl_get_zero_initialized_service();
      CHECK(rcl_service_init(&service, &node, trigger, "/s1", &options));
      break;
    }
    default:
      publisher("/rslcpp/error_code");
      tick(1000, 0, NULL);
  }
}

static void hear(Input *input) {
  std_msgs__msg__UInt64 message;
  rmw_message_info_t info;
  if (rcl_take(&input->handle, &message, &info, NULL) != RCL_RET_OK) return;
  send(input->target, step(input->seed, &message.data));
  if (!input->asks) return;
  std_srvs__srv__Trigger_Request request;
  std_srvs__srv__Trigger_Request__init(&request);
  int64_t number;
  CHECK(rcl_send_request(&client, &request, &number));
}

static void answer(void) {
  rmw_request_id_t id;
  std_srvs__srv__Trigger_Request request;
  std_srvs__srv__Trigger_Request__init(&request);
  if (rcl_take_request(&service, &id, &request) != RCL_RET_OK) return;
  std_srvs__srv__Trigger_Response response;
  std_srvs__srv__Trigger_Response__init(&response);
  char text[32];
  snprintf(text, sizeof text, "%llu", (unsigned long long)step(33396054244, NULL));
  response.success = true;
  rosidl_runtime_c__String__assign(&response.message, text);
  CHECK(rcl_send_response(&service, &id, &response));
  std_srvs__srv__Trigger_Response__fini(&response);
}

static void take_answer(void) {
  rmw_request_id_t id;
  std_srvs__srv__Trigger_Response response;
  std_srvs__srv__Trigger_Response__init(&response);
  if (rcl_take_response(&client, &id, &response) == RCL_RET_OK) {
    const uint64_t value = strtoull(response.message.data, NULL, 10);
    step(44442759714, &value);
  }
  std_srvs__srv__Trigger_Response__fini(&response);
}

static void on_signal(int number) {
  (void)number;
  is_over = 1;
  CHECK(rcl_trigger_guard_condition(&ended));
}

int main(int argc, const char **argv) {
  allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  CHECK(rcl_logging_configure(&context.global_arguments, &allocator));
  const char *letter = argc > 1 ? argv[1] : "monitor";
  char name[32];
  is_monitor = strcmp(letter, "monitor") == 0;
  snprintf(name, sizeof name, is_monitor ? "%s" : "node_%s", letter);
  node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  node_options.enable_rosout = true;
  CHECK(rcl_node_init(&node, name, "", &context, &node_options));
  CHECK(rcl_logging_rosout_init_publisher_for_node(&node));
  CHECK(rcl_clock_init(RCL_ROS_TIME, &ros_clock, &allocator));
  ended = rcl_get_zero_initialized_guard_condition();
  CHECK(rcl_guard_condition_init(&ended, &context, rcl_guard_condition_get_default_options()));
  make_node(letter);
  signal(SIGINT, on_signal);
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, input_count, 1, ticker_count, is_client, is_service, 0, &context,
                          allocator));
  while (!is_over) {
    CHECK(rcl_wait_set_clear(&set));
    for (size_t i = 0; i < input_count; i++) {
      CHECK(rcl_wait_set_add_subscription(&set, &inputs[i].handle, NULL));
    }
    for (size_t i = 0; i < ticker_count; i++) {
      CHECK(rcl_wait_set_add_timer(&set, &tickers[i].handle, NULL));
    }
    if (is_client) CHECK(rcl_wait_set_add_client(&set, &client, NULL));
    if (is_service) CHECK(rcl_wait_set_add_service(&set, &service, NULL));
    CHECK(rcl_wait_set_add_guard_condition(&set, &ended, NULL));
    const rcl_ret_t told = rcl_wait(&set, -1);
    if (told == RCL_RET_TIMEOUT) continue;
    CHECK(told);
    for (size_t i = 0; i < ticker_count; i++) {
      if (set.timers[i] != NULL) CHECK(rcl_timer_call(&tickers[i].handle));
    }
    for (size_t i = 0; i < input_count; i++) {
      if (set.subscriptions[i] != NULL) hear(&inputs[i]);
    }
    if (is_service && set.services[0] != NULL) answer();
    if (is_client && set.clients[0] != NULL) take_answer();
  }
  if (!is_monitor) RCUTILS_LOG_INFO_NAMED(name, "final state %llu", (unsigned long long)state);
  return 0;
}
