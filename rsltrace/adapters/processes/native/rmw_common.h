// What the rmw functions share: the name of this implementation, and checks of arguments.
#pragma once

#include <rcutils/error_handling.h>
#include <rcutils/strdup.h>
#include <rmw/error_handling.h>
#include <rmw/rmw.h>

#include <cstring>
#include <string>

#include "endpoints.h"
#include "qos.h"

namespace rsltrace {

extern const char *const IDENTIFIER;

inline bool ours(const char *identifier) {
  return identifier != nullptr &&
         (identifier == IDENTIFIER || std::strcmp(identifier, IDENTIFIER) == 0);
}

rmw_qos_profile_t read_qos(Reader &reader);
// The QoS that an endpoint has settled on.
rmw_ret_t actual_qos(const Endpoint &endpoint, rmw_qos_profile_t *qos);
void read_gid(const Endpoint &endpoint, std::uint8_t *gid);
rmw_ret_t unsupported(const char *what);
// The number of a node, of which its data is made.
std::uint32_t node_id(const rmw_node_t *node);
char *copied(const char *text);

}  // namespace rsltrace

#define RSLTRACE_NOT_NULL(argument)                                       \
  do {                                                                    \
    if ((argument) == nullptr) {                                          \
      RMW_SET_ERROR_MSG(#argument " is null");                            \
      return RMW_RET_INVALID_ARGUMENT;                                    \
    }                                                                     \
  } while (false)

#define RSLTRACE_OURS(handle)                                             \
  do {                                                                    \
    RSLTRACE_NOT_NULL(handle);                                            \
    if (!rsltrace::ours((handle)->implementation_identifier)) {           \
      RMW_SET_ERROR_MSG(#handle " is of another rmw implementation");     \
      return RMW_RET_INCORRECT_RMW_IMPLEMENTATION;                        \
    }                                                                     \
  } while (false)
