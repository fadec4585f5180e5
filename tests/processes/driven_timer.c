// A timer of 100 ms of ROS time that /clock drives, on rcl alone: a thread of its own sets the clock, as
// in rclcpp, and main waits for nothing but the timer. It says each call on /ticks, and cancels the timer
// at the fifth.
#include <pthread.h>
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosgraph_msgs/msg/clock.h>
#include <std_msgs/msg/u_int64.h>
#include <stdio.h>
#include <stdlib.h>

#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)

static rcl_context_t context;
static rcl_node_t node;
static rcl_clock_t clock_of_node;
static rcl_publisher_t ticks;
static uint64_t ticked = 0;

static void on_timer(rcl_timer_t *timer, int64_t since_last) {
  (void)since_last;
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  message.data = ++ticked;
  CHECK(rcl_publish(&ticks, &message, NULL));
  if (ticked == 5) CHECK(rcl_timer_cancel(timer));
}

static void *set_clock(void *unused) {
  rcl_subscription_options_t options = rcl_subscription_get_default_options();
  rcl_subscription_t times = rcl_get_zero_initialized_subscription();
  CHECK(rcl_subscription_init(&times, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(rosgraph_msgs, msg, Clock),
                              "/clock", &options));
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 1, 0, 0, 0, 0, 0, &context, rcl_get_default_allocator()));
  rosgraph_msgs__msg__Clock now;
  rosgraph_msgs__msg__Clock__init(&now);
  while (true) {
    CHECK(rcl_wait_set_clear(&set));
    CHECK(rcl_wait_set_add_subscription(&set, &times, NULL));
    CHECK(rcl_wait(&set, -1));
    rmw_message_info_t info;
    if (rcl_take(&times, &now, &info, NULL) != RCL_RET_OK) continue;
    const int64_t time_ns = now.clock.sec * 1000000000LL + now.clock.nanosec;
    CHECK(rcl_set_ros_time_override(&clock_of_node, time_ns));
  }
  return unused;
}

int main(int argc, const char **argv) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "driven", "", &context, &node_options));
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  ticks = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&ticks, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64),
                           "ticks", &publisher_options));
  CHECK(rcl_clock_init(RCL_ROS_TIME, &clock_of_node, &allocator));
  CHECK(rcl_enable_ros_time_override(&clock_of_node));
  rcl_timer_t timer = rcl_get_zero_initialized_timer();
  CHECK(rcl_timer_init2(&timer, &clock_of_node, &context, RCL_MS_TO_NS(100), on_timer, allocator,
                        true));
  pthread_t thread;
  if (pthread_create(&thread, NULL, set_clock, NULL) != 0) return 9;
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 0, 0, 1, 0, 0, 0, &context, allocator));
  while (rcl_context_is_valid(&context)) {
    CHECK(rcl_wait_set_clear(&set));
    CHECK(rcl_wait_set_add_timer(&set, &timer, NULL));
    const rcl_ret_t told = rcl_wait(&set, -1);
    if (told == RCL_RET_TIMEOUT) continue;
    CHECK(told);
    if (set.timers[0] != NULL) CHECK(rcl_timer_call(&timer));
  }
  return 0;
}
