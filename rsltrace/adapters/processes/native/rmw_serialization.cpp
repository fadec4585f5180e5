// Messages as bytes, for those who handle bytes themselves.
#include "rmw_common.h"

using namespace rsltrace;

RSLTRACE_EXPORT rmw_ret_t rmw_serialize(const void *message,
                                        const rosidl_message_type_support_t *type_support,
                                        rmw_serialized_message_t *serialized) {
  RSLTRACE_NOT_NULL(message);
  RSLTRACE_NOT_NULL(serialized);
  MessageCodec type;
  std::vector<std::uint8_t> data;
  if (!type.find(type_support) || !type.serialize(message, data)) return RMW_RET_ERROR;
  if (serialized->buffer_capacity < data.size()) {
    if (rmw_serialized_message_resize(serialized, data.size()) != RMW_RET_OK) {
      return RMW_RET_BAD_ALLOC;
    }
  }
  std::memcpy(serialized->buffer, data.data(), data.size());
  serialized->buffer_length = data.size();
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_deserialize(const rmw_serialized_message_t *serialized,
                                          const rosidl_message_type_support_t *type_support,
                                          void *message) {
  RSLTRACE_NOT_NULL(serialized);
  RSLTRACE_NOT_NULL(message);
  MessageCodec type;
  if (!type.find(type_support)) return RMW_RET_ERROR;
  const bool whole = type.deserialize(serialized->buffer, serialized->buffer_length, message);
  return whole ? RMW_RET_OK : RMW_RET_ERROR;
}

RSLTRACE_EXPORT rmw_ret_t rmw_get_serialized_message_size(
    const rosidl_message_type_support_t *, const rosidl_runtime_c__Sequence__bound *, size_t *) {
  return unsupported("serialized sizes of bounded messages");
}
