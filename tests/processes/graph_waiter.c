// Waits on rcl alone for two publishers of /late, then for both to go: by changes of the graph. Says
// on /found how many publishers there are.
#include <rcl/error_handling.h>
#include <rcl/graph.h>
#include <rcl/rcl.h>
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

static void say(rcl_publisher_t *publisher, uint64_t number) {
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  message.data = number;
  CHECK(rcl_publish(publisher, &message, NULL));
}

int main(int argc, const char **argv) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  rcl_context_t context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "waiter", "", &context, &node_options));
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  rcl_publisher_t found = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&found, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64),
                           "found", &publisher_options));

  // Not rcl_wait_for_publishers, which waits for the condition once only, then for nothing.
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 0, 1, 0, 0, 0, 0, &context, allocator));
  size_t count = 0;
  bool were_there = false;
  while (count > 0 || !were_there) {
    CHECK(rcl_wait_set_clear(&set));
    CHECK(rcl_wait_set_add_guard_condition(&set, rcl_node_get_graph_guard_condition(&node), NULL));
    CHECK(rcl_wait(&set, -1));
    size_t now = 0;
    CHECK(rcl_count_publishers(&node, "/late", &now));
    if (now != count) say(&found, now);
    count = now;
    were_there = were_there || count == 2;
  }
  bool is_there = false;  // nobody ever makes it: over by its time
  CHECK(rcl_wait_for_publishers(&node, &allocator, "/never", 1, RCL_MS_TO_NS(100), &is_there) ==
                RCL_RET_TIMEOUT
            ? RCL_RET_OK
            : RCL_RET_ERROR);
  say(&found, 100);
  return 0;
}
