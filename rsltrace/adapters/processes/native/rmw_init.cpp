// Contexts: there is one domain, that of the run.
#include <rmw/discovery_options.h>
#include <rmw/features.h>
#include <rmw/init.h>
#include <rmw/init_options.h>

#include "rmw_common.h"

using namespace rsltrace;

struct rmw_context_impl_s {
  bool is_shut_down = false;
};

RSLTRACE_EXPORT const char *rmw_get_implementation_identifier() { return IDENTIFIER; }

RSLTRACE_EXPORT const char *rmw_get_serialization_format() { return "cdr"; }

RSLTRACE_EXPORT bool rmw_feature_supported(rmw_feature_t feature) {
  return feature == RMW_FEATURE_MESSAGE_INFO_PUBLICATION_SEQUENCE_NUMBER ||
         feature == RMW_FEATURE_MESSAGE_INFO_RECEPTION_SEQUENCE_NUMBER;
}

RSLTRACE_EXPORT rmw_ret_t rmw_init_options_init(rmw_init_options_t *options,
                                                rcutils_allocator_t allocator) {
  RSLTRACE_NOT_NULL(options);
  if (options->implementation_identifier != nullptr) {
    RMW_SET_ERROR_MSG("the init options are initialized already");
    return RMW_RET_INVALID_ARGUMENT;
  }
  options->instance_id = 0;
  options->implementation_identifier = IDENTIFIER;
  options->allocator = allocator;
  options->impl = nullptr;
  options->enclave = nullptr;
  options->domain_id = RMW_DEFAULT_DOMAIN_ID;
  options->security_options = rmw_get_default_security_options();
  options->discovery_options = rmw_get_zero_initialized_discovery_options();
  return rmw_discovery_options_init(&options->discovery_options, 0, &allocator);
}

RSLTRACE_EXPORT rmw_ret_t rmw_init_options_copy(const rmw_init_options_t *source,
                                                rmw_init_options_t *target) {
  RSLTRACE_OURS(source);
  RSLTRACE_NOT_NULL(target);
  if (target->implementation_identifier != nullptr) {
    RMW_SET_ERROR_MSG("the init options to copy to are initialized already");
    return RMW_RET_INVALID_ARGUMENT;
  }
  rcutils_allocator_t allocator = source->allocator;
  rmw_init_options_t copy = *source;
  copy.enclave = source->enclave == nullptr ? nullptr : rcutils_strdup(source->enclave, allocator);
  copy.security_options = rmw_get_zero_initialized_security_options();
  copy.discovery_options = rmw_get_zero_initialized_discovery_options();
  rmw_ret_t result =
      rmw_security_options_copy(&source->security_options, &allocator, &copy.security_options);
  if (result == RMW_RET_OK) {
    result =
        rmw_discovery_options_copy(&source->discovery_options, &allocator, &copy.discovery_options);
  }
  if (result == RMW_RET_OK) *target = copy;
  return result;
}

RSLTRACE_EXPORT rmw_ret_t rmw_init_options_fini(rmw_init_options_t *options) {
  RSLTRACE_OURS(options);
  rcutils_allocator_t allocator = options->allocator;
  allocator.deallocate(options->enclave, allocator.state);
  rmw_ret_t result = rmw_security_options_fini(&options->security_options, &allocator);
  if (result == RMW_RET_OK) result = rmw_discovery_options_fini(&options->discovery_options);
  *options = rmw_get_zero_initialized_init_options();
  return result;
}

RSLTRACE_EXPORT rmw_ret_t rmw_init(const rmw_init_options_t *options, rmw_context_t *context) {
  RSLTRACE_OURS(options);
  RSLTRACE_NOT_NULL(context);
  if (context->implementation_identifier != nullptr) {
    RMW_SET_ERROR_MSG("the context is initialized already");
    return RMW_RET_INVALID_ARGUMENT;
  }
  if (!linked()) {
    RMW_SET_ERROR_MSG(
        "this process was started by one that rsltrace runs, and is no part of the run: start it "
        "from the job");
    return RMW_RET_ERROR;
  }
  context->instance_id = options->instance_id;
  context->implementation_identifier = IDENTIFIER;
  context->actual_domain_id =
      options->domain_id == RMW_DEFAULT_DOMAIN_ID ? 0 : options->domain_id;
  context->options = rmw_get_zero_initialized_init_options();
  const rmw_ret_t result = rmw_init_options_copy(options, &context->options);
  if (result != RMW_RET_OK) return result;
  context->impl = new rmw_context_impl_s;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_shutdown(rmw_context_t *context) {
  RSLTRACE_OURS(context);
  context->impl->is_shut_down = true;
  return RMW_RET_OK;
}

RSLTRACE_EXPORT rmw_ret_t rmw_context_fini(rmw_context_t *context) {
  RSLTRACE_OURS(context);
  if (!context->impl->is_shut_down) {
    RMW_SET_ERROR_MSG("the context has not been shut down");
    return RMW_RET_INVALID_ARGUMENT;
  }
  delete context->impl;
  const rmw_ret_t result = rmw_init_options_fini(&context->options);
  *context = rmw_get_zero_initialized_context();
  return result;
}
