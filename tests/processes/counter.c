// A node on rcl alone: a timer counts, and what comes in on /echo goes out on /heard.
//
// Usage: counter [period in ms] [when to leave, or what to do at the fifth count: crash, exit, …]
// Instead it publishes with "address" where its timer lies, with "heap" where new memory lies after a
// draw, with "rand" the last of 90 random numbers and one for each count, with "thread" its thread's id, with "heaps" from how many heaps two threads, one after the
// other, got memory. It counts from the number in COUNT_FROM, and from that in the file "more" in its
// folder. With LATE_PYTHON it loads that libpython, and starts it. With NAMED there is another node, and callbacks are told to tracetools as rclcpp does it.
#include <dlfcn.h>
#include <pthread.h>
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <semaphore.h>
#include <signal.h>
#include <std_msgs/msg/u_int64.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <tracetools/tracetools.h>
#include <unistd.h>

#define CHECK(call)                                                            \
  do {                                                                         \
    if ((call) != RCL_RET_OK) {                                                \
      fprintf(stderr, "%s: %s\n", #call, rcl_get_error_string().str);          \
      exit(9);                                                                 \
    }                                                                          \
  } while (0)

static const char *action = "";
static rcl_publisher_t count_publisher;
static uint64_t counted = 0;

static pthread_key_t slow_key;

// What libc calls last at the end of a thread, for longer than another takes to begin.
static void end_slowly(void *rounds) {
  if (rounds != (void *)1) {
    pthread_setspecific(slow_key, (char *)rounds - 1);
    return;
  }
  for (volatile int i = 0; i < 50000000; i++) {
  }
}

static void *heap_of_thread(void *heap) {
  void *memory = malloc(100);
  *(uintptr_t *)heap = (uintptr_t)memory >> 26;  // libc's heaps begin at multiples of 64 MiB
  free(memory);
  pthread_setspecific(slow_key, (void *)4);
  return NULL;
}

static uint64_t heaps_of_threads(void) {
  pthread_t threads[2];
  uintptr_t heaps[2];
  pthread_key_create(&slow_key, end_slowly);
  for (int i = 0; i < 2; i++) pthread_create(&threads[i], NULL, heap_of_thread, &heaps[i]);
  for (int i = 0; i < 2; i++) pthread_join(threads[i], NULL);
  pthread_key_delete(slow_key);
  return heaps[0] == heaps[1] ? 1 : 2;
}

static uint64_t heap_after_draw(void) {
  srand(1);
  rand();
  void *memory = malloc(100);
  const uint64_t where = (uintptr_t)memory;
  free(memory);
  return where;
}

// As rclcpp waits for signals.
static sem_t signalled;

static void on_signal(int number) {
  (void)number;
  sem_post(&signalled);
}

static void *wait_for_signals(void *unused) {
  for (;;) sem_wait(&signalled);
  return unused;
}

static void on_timer(rcl_timer_t *timer, int64_t since_last) {
  (void)since_last;
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  message.data = ++counted;
  if (strcmp(action, "address") == 0) message.data = (uint64_t)(uintptr_t)timer;
  if (strcmp(action, "heap") == 0) message.data = heap_after_draw();
  for (uint64_t i = strcmp(action, "rand") == 0 ? 90 + counted : 0; i > 0; i--) message.data = rand();
  if (strcmp(action, "thread") == 0) message.data = (uint64_t)pthread_self();
  if (strcmp(action, "heaps") == 0) message.data = heaps_of_threads();
  // As rclcpp does with use_intra_process_comms: "both" if somebody outside of the process listens.
  if (strcmp(action, "intra") == 0 || strcmp(action, "both") == 0)
    ros_trace_rclcpp_intra_publish(&count_publisher, &message);
  if (strcmp(action, "intra") != 0) CHECK(rcl_publish(&count_publisher, &message, NULL));
  if (counted == 5 && strcmp(action, "crash") == 0) raise(SIGSEGV);
  if (counted == 5 && strcmp(action, "kill") == 0) raise(SIGKILL);
  if (counted == 5 && strcmp(action, "exit") == 0) _exit(7);
  if (counted == 5 && strcmp(action, "leave") == 0) exit(0);
  if (counted == 5 && strcmp(action, "fork") == 0 && fork() == 0) {
    sleep(60);
    _exit(0);
  }
  if (counted == 5 && strcmp(action, "close") == 0) {
    for (int fd = 3; fd < 1024; fd++) close(fd);
  }
  if (counted == 5 && strcmp(action, "exec") == 0) execl("/bin/sleep", "sleep", "60", (char *)NULL);
  if (counted == 5 && strcmp(action, "write") == 0) {
    for (int fd = 3; fd < 1024; fd++) (void)!write(fd, "\3\0\0\0abc", 7);
  }
  if (counted == strtoull(action, NULL, 10)) exit(0);
  if (counted == 5 && strcmp(action, "lock") == 0) {
    pthread_t thread;
    sem_init(&signalled, 0, 0);
    signal(SIGINT, on_signal);
    pthread_create(&thread, NULL, wait_for_signals, NULL);
    pthread_join(thread, NULL);
  }
  while (counted == 5 && strcmp(action, "hang") == 0) {
  }
}

static uint64_t first(void) {
  const char *from = getenv("COUNT_FROM");
  uint64_t count = from == NULL ? 0 : strtoull(from, NULL, 10);
  FILE *more = fopen("more", "r");
  char text[16] = "";
  if (more != NULL && fgets(text, sizeof text, more) != NULL) count += strtoull(text, NULL, 10);
  if (more != NULL) fclose(more);
  return count;
}

static void tell_names(const rcl_node_t *node, const rcl_timer_t *timer,
                       const rcl_subscription_t *echo) {
  static const char callbacks[2], subscription;
  ros_trace_rclcpp_timer_callback_added(timer, &callbacks[0]);
  if (ros_trace_enabled_rclcpp_callback_register())
    ros_trace_do_rclcpp_callback_register(&callbacks[0], "Counter::tick()");
  ros_trace_rclcpp_timer_link_node(timer, node);
  ros_trace_rclcpp_subscription_init(echo, &subscription);
  ros_trace_rclcpp_subscription_callback_added(&subscription, &callbacks[1]);
  ros_trace_rclcpp_callback_register(&callbacks[1], "Counter::echo(UInt64)");
}

static void start_python(const char *library) {
  void *python = dlopen(library, RTLD_NOW | RTLD_GLOBAL);
  void (*start)(int) = (void (*)(int))dlsym(python, "Py_InitializeEx");
  int (*run)(const char *) = (int (*)(const char *))dlsym(python, "PyRun_SimpleString");
  start(0);
  if (run("import json\nassert json.loads('[true]')[0] is (1 == 1) and RuntimeError('x').args") != 0)
    exit(8);
}

int main(int argc, const char **argv) {
  if (getenv("LATE_PYTHON") != NULL) start_python(getenv("LATE_PYTHON"));
  counted = first();
  const int64_t period_ms = argc > 1 && argv[1][0] != '-' ? atoi(argv[1]) : 100;
  if (argc > 2 && argv[2][0] != '-') action = argv[2];
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  CHECK(rcl_init_options_init(&options, allocator));
  rcl_context_t context = rcl_get_zero_initialized_context();
  CHECK(rcl_init(argc, argv, &options, &context));
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  CHECK(rcl_node_init(&node, "counter", "", &context, &node_options));
  const rosidl_message_type_support_t *type =
      ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64);
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  count_publisher = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&count_publisher, &node, type, "count", &publisher_options));
  rcl_publisher_t heard = rcl_get_zero_initialized_publisher();
  CHECK(rcl_publisher_init(&heard, &node, type, "heard", &publisher_options));
  rcl_subscription_options_t subscription_options = rcl_subscription_get_default_options();
  rcl_subscription_t echo = rcl_get_zero_initialized_subscription();
  CHECK(rcl_subscription_init(&echo, &node, type, "echo", &subscription_options));
  rcl_node_t other = rcl_get_zero_initialized_node();
  if (getenv("NAMED") != NULL) CHECK(rcl_node_init(&other, "other", "", &context, &node_options));
  rcl_clock_t clock;
  CHECK(rcl_clock_init(RCL_STEADY_TIME, &clock, &allocator));
  rcl_timer_t timer = rcl_get_zero_initialized_timer();
  CHECK(rcl_timer_init2(&timer, &clock, &context, RCL_MS_TO_NS(period_ms), on_timer, allocator,
                        true));
  if (getenv("NAMED") != NULL) tell_names(&node, &timer, &echo);
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  CHECK(rcl_wait_set_init(&set, 1, 0, 1, 0, 0, 0, &context, allocator));
  std_msgs__msg__UInt64 message;
  std_msgs__msg__UInt64__init(&message);
  while (rcl_context_is_valid(&context)) {
    CHECK(rcl_wait_set_clear(&set));
    CHECK(rcl_wait_set_add_subscription(&set, &echo, NULL));
    CHECK(rcl_wait_set_add_timer(&set, &timer, NULL));
    const rcl_ret_t told = rcl_wait(&set, -1);
    if (told == RCL_RET_TIMEOUT) continue;
    CHECK(told);
    if (set.timers[0] != NULL) CHECK(rcl_timer_call(&timer));
    if (set.subscriptions[0] != NULL) {
      rmw_message_info_t info;
      if (rcl_take(&echo, &message, &info, NULL) == RCL_RET_OK) {
        CHECK(rcl_publish(&heard, &message, NULL));
      }
    }
  }
  return 0;
}
