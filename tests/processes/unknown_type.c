// Publishes a message of a package whose libraries are "nowhere", and says why it cannot.
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosidl_typesupport_c/identifier.h>
#include <rosidl_typesupport_c/message_type_support_dispatch.h>
#include <rosidl_typesupport_c/type_support_map.h>
#include <stdio.h>

static const char *const kinds[] = {"rosidl_typesupport_fastrtps_c"};
static const char *const symbols[] = {"none"};
static void *data[] = {NULL};
static const type_support_map_t map = {1, "nowhere", kinds, symbols, data};

int main(int argc, const char **argv) {
  rosidl_message_type_support_t type = {0};
  type.typesupport_identifier = rosidl_typesupport_c__typesupport_identifier;
  type.data = &map;
  type.func = rosidl_typesupport_c__get_message_typesupport_handle_function;
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  rcl_publisher_t publisher = rcl_get_zero_initialized_publisher();
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  if (rcl_init_options_init(&options, rcl_get_default_allocator()) != RCL_RET_OK ||
      rcl_init(argc, argv, &options, &context) != RCL_RET_OK ||
      rcl_node_init(&node, "node", "", &context, &node_options) != RCL_RET_OK)
    return 1;
  const rcl_ret_t made = rcl_publisher_init(&publisher, &node, &type, "t", &publisher_options);
  fprintf(stderr, "%s\n", rcl_get_error_string().str);
  return made == RCL_RET_OK;
}
