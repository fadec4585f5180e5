#include "typesupport.h"

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <rcutils/error_handling.h>
#include <rmw/error_handling.h>
#include <rosidl_typesupport_fastrtps_cpp/message_type_support.h>
#include <rosidl_typesupport_fastrtps_cpp/service_type_support.h>

#include <cstdlib>
#include <exception>
#include <string>

namespace rsltrace {

namespace {

using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

constexpr const char *KINDS[] = {"rosidl_typesupport_fastrtps_c",
                                 "rosidl_typesupport_fastrtps_cpp"};
constexpr std::size_t ENCAPSULATION = 4;
constexpr std::size_t ERROR_MAX = 500;  // rcutils cuts what is longer, with a warning

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

// Why the library that was looked for is not used, "" if the language is another one; the error is
// reset.
std::string why_not() {
  const std::string text = rcutils_get_error_string().str;
  rcutils_reset_error();
  const bool is_other = text.find("is not supported by this library") != std::string::npos;
  return is_other ? "" : ": " + text.substr(0, text.find(", at /"));
}

void set_not_found(const char *what, const std::string &tried) {
  const char *folders = std::getenv("LD_LIBRARY_PATH");
  const std::string text = std::string("the ") + what + " has no type support for Fast DDS" + tried +
                           "; source the workspace that has its package. LD_LIBRARY_PATH is " +
                           (folders == nullptr ? "not set" : folders);
  RMW_SET_ERROR_MSG(text.substr(0, ERROR_MAX).c_str());
}

}  // namespace

bool MessageCodec::find(const rosidl_message_type_support_t *given) {
  if (given == nullptr) {
    RMW_SET_ERROR_MSG("no type support was given");
    return false;
  }
  std::string tried;
  for (const char *kind : KINDS) {
    const auto *found = get_message_typesupport_handle(given, kind);
    if (found != nullptr) {
      callbacks_ = static_cast<const message_type_support_callbacks_t *>(found->data);
      return true;
    }
    tried += why_not();
  }
  set_not_found("message", tried);
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
  std::string tried;
  for (const char *kind : KINDS) {
    const auto *found = get_service_typesupport_handle(given, kind);
    if (found != nullptr) {
      const auto *service = static_cast<const service_type_support_callbacks_t *>(found->data);
      name = joined(service->service_namespace_, service->service_name_);
      return request.find(service->request_members_) && response.find(service->response_members_);
    }
    tried += why_not();
  }
  set_not_found("service", tried);
  return false;
}

}  // namespace rsltrace
