// The node of robot_mains:count on rcl: it publishes numbers and a text that all others publish, too,
// and writes down what it has sent and got, and in a file that it has heard enough of each.
//
// Usage: counting [where to write] [first number] [period in ms] [threads: eight more publish]
#include <pthread.h>
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosidl_runtime_c/string_functions.h>
#include <signal.h>
#include <std_msgs/msg/string.h>
#include <std_msgs/msg/u_int64.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <tracetools/tracetools.h>

#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)

static volatile sig_atomic_t is_over = 0;
static rcl_publisher_t out, say;
static std_msgs__msg__UInt64 number;
static std_msgs__msg__String text;
static uint64_t next;

static void end(int signal) {
  (void)signal;
  is_over = 1;
}

static void on_timer(rcl_timer_t *timer, int64_t since_last) {
  (void)timer, (void)since_last;
  number.data = next++;
  CHECK(rcl_publish(&out, &number, NULL));
  CHECK(rcl_publish(&say, &text, NULL));
}

static void *publish(void *from) {
  std_msgs__msg__UInt64 own = {(uint64_t)from};
  for (int i = 0; i < 2000; i++, own.data++) CHECK(rcl_publish(&out, &own, NULL));
  return NULL;
}

static void note_if_enough(uint64_t heard, uint64_t first) {
  static int of_each[5];
  of_each[heard / 100000 % 5]++;
  for (int i = 1; i < 5; i++)
    if (of_each[i] < 21) return;
  char name[16];
  snprintf(name, sizeof name, "%d.heard", (int)(first / 100000));
  fclose(fopen(name, "w"));
}

int main(int argc, const char **argv) {
  const uint64_t first = next = strtoull(argv[2], NULL, 10);
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  rcl_context_t context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "counting", "", &context, &node_options));
  const rosidl_message_type_support_t *numbers = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64);
  const rosidl_message_type_support_t *texts = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, String);
  rcl_publisher_options_t publishers = rcl_publisher_get_default_options();
  rcl_subscription_options_t subscriptions = rcl_subscription_get_default_options();
  publishers.qos.depth = subscriptions.qos.depth = 10000;
  out = say = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&out, &node, numbers, "/numbers", &publishers));
  CHECK(rcl_publisher_init(&say, &node, texts, "/same", &publishers));
  rcl_subscription_t in[2] = {rcl_get_zero_initialized_subscription(),
                              rcl_get_zero_initialized_subscription()};
  CHECK(rcl_subscription_init(&in[0], &node, numbers, "/numbers", &subscriptions));
  CHECK(rcl_subscription_init(&in[1], &node, texts, "/same", &subscriptions));
  std_msgs__msg__String__init(&text);
  rosidl_runtime_c__String__assign(&text.data, "the same");
  rcl_clock_t clock;
  CHECK(rcl_clock_init(RCL_STEADY_TIME, &clock, &allocator));
  rcl_timer_t timer = rcl_get_zero_initialized_timer();
  CHECK(rcl_timer_init2(&timer, &clock, &context, RCL_MS_TO_NS(atoi(argv[3])), on_timer, allocator,
                        true));
  ros_trace_rclcpp_timer_callback_added(&timer, &timer);
  ros_trace_rclcpp_callback_register(&timer, "Counting.on_timer");
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 2, 0, 1, 0, 0, 0, &context, allocator));
  signal(SIGINT, end);

  const int has_threads = argc > 4 && strcmp(argv[4], "threads") == 0;
  pthread_t threads[8] = {0};
  for (int i = 0; has_threads && i < 8; i++)
    pthread_create(&threads[i], NULL, publish, (void *)(uintptr_t)(1000000 * (i + 1)));

  static uint64_t got[1 << 20];
  size_t count = 0, same = 0;
  std_msgs__msg__UInt64 message;
  std_msgs__msg__String other;
  std_msgs__msg__String__init(&other);
  while (!is_over) {
    CHECK(rcl_wait_set_clear(&set));
    for (int i = 0; i < 2; i++) CHECK(rcl_wait_set_add_subscription(&set, &in[i], NULL));
    CHECK(rcl_wait_set_add_timer(&set, &timer, NULL));
    const rcl_ret_t told = rcl_wait(&set, RCL_MS_TO_NS(20));
    if (told == RCL_RET_TIMEOUT) continue;
    CHECK(told);
    if (set.timers[0] != NULL) CHECK(rcl_timer_call(&timer));
    if (set.subscriptions[0] != NULL && rcl_take(&in[0], &message, NULL, NULL) == RCL_RET_OK)
      note_if_enough(got[count++] = message.data, first);
    if (set.subscriptions[1] != NULL && rcl_take(&in[1], &other, NULL, NULL) == RCL_RET_OK) same++;
  }
  for (int i = 0; has_threads && i < 8; i++) pthread_join(threads[i], NULL);
  FILE *file = fopen(argv[1], "w");
  fprintf(file, "{\"sent\": %lu, \"same\": %lu, \"got\": [", next - first, same);
  for (size_t i = 0; i < count; i++) fprintf(file, i == 0 ? "%lu" : ", %lu", got[i]);
  fprintf(file, "]}");
  CHECK(fclose(file));
  // Fast DDS crashes or spins now and then if a program ends while it has nodes.
  CHECK(rcl_wait_set_fini(&set));
  CHECK(rcl_timer_fini(&timer));
  CHECK(rcl_clock_fini(&clock));
  for (int i = 0; i < 2; i++) CHECK(rcl_subscription_fini(&in[i], &node));
  CHECK(rcl_publisher_fini(&out, &node));
  CHECK(rcl_publisher_fini(&say, &node));
  CHECK(rcl_node_fini(&node));
  CHECK(rcl_shutdown(&context));
  CHECK(rcl_context_fini(&context));
  return 0;
}
