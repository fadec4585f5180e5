// Log records: rcl publishes them on /rosout, which is how they get into the trace. What it would
// print goes to the loop, which prints all nodes' alike, and nothing is written to files.
#include <rcl_logging_interface/rcl_logging_interface.h>
#include <rcutils/format_string.h>
#include <rcutils/logging.h>
#include <stdarg.h>
#include <stdio.h>

#include "link.h"

using namespace rsltrace;

RSLTRACE_EXPORT void rcutils_logging_console_output_handler(
    const rcutils_log_location_t *location, int severity, const char *name,
    rcutils_time_point_value_t timestamp, const char *format, va_list *args) {
  if (!linked()) {
    using Handler = decltype(rcutils_logging_console_output_handler);
    static const auto real = reinterpret_cast<Handler *>(
        original("librcutils.so", "rcutils_logging_console_output_handler"));
    return real(location, severity, name, timestamp, format, args);
  }
  va_list copy;
  va_copy(copy, *args);
  const int size = vsnprintf(nullptr, 0, format, copy);
  va_end(copy);
  std::string text(size > 0 ? static_cast<std::size_t>(size) + 1 : 1, '\0');
  va_copy(copy, *args);
  vsnprintf(text.data(), text.size(), format, copy);
  va_end(copy);
  text.pop_back();
  Writer body;
  body.number(static_cast<std::uint32_t>(severity));
  body.text(name == nullptr ? "" : name);
  body.text(text);
  say(Say::LOG, body);
}

RSLTRACE_EXPORT rcl_logging_ret_t rcl_logging_external_initialize(const char *, const char *,
                                                                  rcutils_allocator_t) {
  return RCL_LOGGING_RET_OK;
}

RSLTRACE_EXPORT rcl_logging_ret_t rcl_logging_external_shutdown() { return RCL_LOGGING_RET_OK; }

RSLTRACE_EXPORT void rcl_logging_external_log(int, const char *, const char *) {}

RSLTRACE_EXPORT rcl_logging_ret_t rcl_logging_external_set_logger_level(const char *, int) {
  return RCL_LOGGING_RET_OK;
}
