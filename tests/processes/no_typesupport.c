// A publisher of a message whose library for Fast DDS is nowhere.
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosidl_runtime_c/message_type_support_struct.h>
#include <rosidl_typesupport_c/identifier.h>
#include <rosidl_typesupport_c/message_type_support_dispatch.h>
#include <rosidl_typesupport_c/type_support_map.h>
#include <stdio.h>

int main(int argc, const char *const *argv) {
  static const char *identifiers[] = {"rosidl_typesupport_fastrtps_c"};
  static const char *symbols[] = {"nowhere"};
  static void *data[] = {NULL};
  static const type_support_map_t map = {1, "nosuch_msgs", identifiers, symbols, data};
  rosidl_message_type_support_t support = {0};
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  rcl_publisher_t publisher = rcl_get_zero_initialized_publisher();
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  support.typesupport_identifier = rosidl_typesupport_c__typesupport_identifier;
  support.data = &map;
  support.func = rosidl_typesupport_c__get_message_typesupport_handle_function;
  if (rcl_init_options_init(&options, rcl_get_default_allocator()) != RCL_RET_OK) return 8;
  if (rcl_init(argc, argv, &options, &context) != RCL_RET_OK) return 8;
  if (rcl_node_init(&node, "lost", "", &context, &node_options) != RCL_RET_OK) return 8;
  if (rcl_publisher_init(&publisher, &node, &support, "t", &publisher_options) != RCL_RET_OK) {
    fprintf(stderr, "%s\n", rcl_get_error_string().str);
    return 9;
  }
  return 0;
}
