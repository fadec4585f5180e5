// Where the program's own code was when a signal killed it, an uncaught exception or abort() too.
// Nothing here takes memory of the heap, which may be broken, or locked by the thread that crashed.
#include <signal.h>
#include <unwind.h>

#include <cstring>

#include "call_sites.h"
#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

constexpr std::uint32_t FRAMES = 16;
constexpr std::size_t PATH_BYTES = 512;
constexpr std::size_t STACK_BYTES = 1 << 16;

struct Crash {
  std::uint32_t count = 0;
  std::size_t size = sizeof count;
  char record[sizeof count + FRAMES * (PATH_BYTES + 12)] = "";

  void append(const void *data, std::size_t bytes) {
    std::memcpy(record + size, data, bytes);
    size += bytes;
  }
};

_Unwind_Reason_Code append_frame(_Unwind_Context *context, void *to) {
  auto &crash = *static_cast<Crash *>(to);
  int is_exact = 0;  // where a signal came; of callers, it is where the call returns to
  const std::uintptr_t address = _Unwind_GetIPInfo(context, &is_exact) - (is_exact == 0);
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void *>(address), &info) == 0 || is_library(info)) return _URC_NO_REASON;
  const auto length = static_cast<std::uint32_t>(strnlen(info.dli_fname, PATH_BYTES));
  const std::uint64_t offset = address - reinterpret_cast<std::uintptr_t>(info.dli_fbase);
  crash.append(&length, sizeof length);
  crash.append(info.dli_fname, length);
  crash.append(&offset, sizeof offset);
  return ++crash.count < FRAMES ? _URC_NO_REASON : _URC_END_OF_STACK;
}

__constinit Crash crash;

// The signal's own effect follows: its handler is the default again.
void tell_crash(int signal) {
  if (self != nullptr && linked()) {
    _Unwind_Backtrace(append_frame, &crash);
    std::memcpy(crash.record, &crash.count, sizeof crash.count);
    say(Say::CRASH, crash.record, crash.size);
  }
  raise(signal);
}

// Not in programs with a Python, which have their tracebacks. Main has a stack for when its own is full.
__attribute__((constructor(102))) void watch_for_crashes() {
  if (!linked() || has_python()) return;
  static char stack[STACK_BYTES];
  stack_t there{};
  there.ss_sp = stack;
  there.ss_size = sizeof stack;
  sigaltstack(&there, nullptr);
  struct sigaction action {};
  action.sa_handler = tell_crash;
  action.sa_flags = static_cast<int>(SA_ONSTACK | SA_RESETHAND);
  for (const int one : {SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV}) sigaction(one, &action, nullptr);
}

}  // namespace
}  // namespace rsltrace
