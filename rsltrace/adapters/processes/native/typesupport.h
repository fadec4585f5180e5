// Messages as canonical CDR: Fast DDS's type support, into memory that has been zeroed.
#pragma once

#include <rosidl_runtime_c/message_type_support_struct.h>
#include <rosidl_runtime_c/service_type_support_struct.h>

#include <cstdint>
#include <string>
#include <vector>

struct message_type_support_callbacks_t;

namespace rsltrace {

class MessageCodec {
 public:
  // Find the type support; false: there is none, and rmw's error says so.
  bool find(const rosidl_message_type_support_t *given);
  bool serialize(const void *message, std::vector<std::uint8_t> &data) const;
  bool deserialize(const std::uint8_t *data, std::size_t size, void *message) const;
  // As in `std_msgs/msg/UInt64`.
  std::string name() const;

 private:
  const message_type_support_callbacks_t *callbacks_ = nullptr;
};

struct ServiceCodec {
  bool find(const rosidl_service_type_support_t *given);
  MessageCodec request;
  MessageCodec response;
  std::string name;
};

}  // namespace rsltrace
