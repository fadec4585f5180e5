#include "typesupport.h"

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <rcutils/error_handling.h>
#include <rmw/error_handling.h>
#include <rosidl_typesupport_fastrtps_cpp/message_type_support.h>
#include <rosidl_typesupport_fastrtps_cpp/service_type_support.h>

#include <exception>

namespace rsltrace {

namespace {

using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

constexpr const char *KINDS[] = {"rosidl_typesupport_fastrtps_c",
                                 "rosidl_typesupport_fastrtps_cpp"};
constexpr std::size_t ENCAPSULATION = 4;

// The dispatch of rosidl says what it has looked for and not found, of each kind.
void not_found(const char *what, const std::string &reasons) {
  const std::string text = std::string("the ") + what +
                           " has no type support for Fast DDS; is the prefix of its package sourced?" + reasons;
  RMW_SET_ERROR_MSG(text.c_str());
}

std::string reason() {
  std::string text;
  if (rcutils_error_is_set()) text = std::string("; ") + rcutils_get_error_string().str;
  rcutils_reset_error();
  return text;
}

// "std_msgs__msg" (C) and "std_msgs::msg" (C++) are one name.
std::string joined(const char *where, const char *name) {
  std::string text = where;
  for (const char *mark : {"::", "__"}) {
    for (auto at = text.find(mark); at != std::string::npos; at = text.find(mark)) {
      text.replace(at, 2, "/");
    }
  }
  return text + "/" + name;
}

}  // namespace

bool MessageCodec::find(const rosidl_message_type_support_t *given) {
  if (given == nullptr) {
    RMW_SET_ERROR_MSG("no type support was given");
    return false;
  }
  std::string reasons;
  for (const char *kind : KINDS) {
    const auto *found = get_message_typesupport_handle(given, kind);
    if (found != nullptr) {
      callbacks_ = static_cast<const message_type_support_callbacks_t *>(found->data);
      return true;
    }
    reasons += reason();
  }
  not_found("message", reasons);
  return false;
}

bool MessageCodec::serialize(const void *message, std::vector<std::uint8_t> &data) const {
  try {
    data.assign(ENCAPSULATION + callbacks_->get_serialized_size(message), 0);
    FastBuffer buffer(reinterpret_cast<char *>(data.data()), data.size());
    Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::CdrVersion::XCDRv1);
    cdr.set_encoding_flag(eprosima::fastcdr::EncodingAlgorithmFlag::PLAIN_CDR);
    cdr.serialize_encapsulation();
    if (!callbacks_->cdr_serialize(message, cdr)) {
      RMW_SET_ERROR_MSG("cannot serialize the message");
      return false;
    }
    data.resize(cdr.get_serialized_data_length());
  } catch (const std::exception &error) {
    RMW_SET_ERROR_MSG(error.what());
    return false;
  }
  return true;
}

bool MessageCodec::deserialize(const std::uint8_t *data, std::size_t size, void *message) const {
  try {
    FastBuffer buffer(const_cast<char *>(reinterpret_cast<const char *>(data)), size);
    Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN);
    cdr.read_encapsulation();
    if (callbacks_->cdr_deserialize(cdr, message)) return true;
    RMW_SET_ERROR_MSG("cannot deserialize the message");
  } catch (const std::exception &error) {
    RMW_SET_ERROR_MSG(error.what());
  }
  return false;
}

std::string MessageCodec::name() const {
  return joined(callbacks_->message_namespace_, callbacks_->message_name_);
}

bool ServiceCodec::find(const rosidl_service_type_support_t *given) {
  if (given == nullptr) {
    RMW_SET_ERROR_MSG("no type support was given");
    return false;
  }
  std::string reasons;
  for (const char *kind : KINDS) {
    const auto *found = get_service_typesupport_handle(given, kind);
    if (found != nullptr) {
      const auto *service = static_cast<const service_type_support_callbacks_t *>(found->data);
      name = joined(service->service_namespace_, service->service_name_);
      return request.find(service->request_members_) && response.find(service->response_members_);
    }
    reasons += reason();
  }
  not_found("service", reasons);
  return false;
}

}  // namespace rsltrace
