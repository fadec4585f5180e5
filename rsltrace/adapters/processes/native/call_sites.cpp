// See call_sites.h. What a caller is, is found out once for each place; stacks are unwound only for
// draws, which are few, and for the first messages of each callback.
#include "call_sites.h"

#include <dlfcn.h>
#include <execinfo.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <unordered_map>
#include <vector>

#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

constexpr int DEPTH = 16;
constexpr int DEPTH_OF_TEMPLATES = 64;  // of rclcpp, unoptimized
constexpr std::uint32_t NOTES_PER_EVENT = 100;  // as many as the guard keeps
constexpr std::uint32_t LOOKS_FIRST = 32;       // at clocks, from each place
constexpr std::uint32_t SENDERS_FIRST = 32;     // as adapters/rclpy/concurrency/code_lines.py

const char *const LIBRARIES[] = {"librcl.so", "librclcpp.so", "libc.so.6", "libstdc++.so.6"};

bool is_library(const Dl_info &info) {
  Dl_info here{};
  if (dladdr(reinterpret_cast<const void *>(&note_sender), &here) != 0 && here.dli_fbase == info.dli_fbase) return true;
  const std::string file = info.dli_fname;
  const auto slash = file.rfind('/');
  if (slash == std::string::npos || file.compare(slash + 1, 3, "lib") != 0) return false;
  for (const char *name : LIBRARIES)
    if (access((file.substr(0, slash + 1) + name).c_str(), F_OK) == 0) return true;
  return false;
}

// Of libraries no more is kept: how long the path of ours is must not show in the heap.
struct Caller {
  bool own = false;
  std::string file;
  std::uint64_t offset = 0;  // of the call, not of where it returns to
  std::uint32_t looks = 0;
};

// dladdr goes through all symbols of a library: once for each place.
Caller &caller_at(const void *address) {
  static auto *known = new std::unordered_map<const void *, Caller>;
  const auto [found, is_new] = known->try_emplace(address);
  Dl_info info{};
  if (!is_new || dladdr(address, &info) == 0 || info.dli_fname == nullptr) return found->second;
  const auto offset = static_cast<const char *>(address) - 1 - static_cast<char *>(info.dli_fbase);
  if (!is_library(info)) found->second = {true, info.dli_fname, static_cast<std::uint64_t>(offset)};
  return found->second;
}

void write_frame(Writer &body, const Caller &caller) {
  body.text(caller.file);
  body.number(caller.offset);
}

// The frames of the program's own code, innermost first.
void write_stack(Writer &body) {
  void *frames[DEPTH];
  const int depth = backtrace(frames, DEPTH);
  const Caller *own[DEPTH];
  std::uint32_t count = 0;
  for (int i = 0; i < depth; ++i)
    if (const Caller &caller = caller_at(frames[i]); caller.own) own[count++] = &caller;
  body.number(count);
  for (std::uint32_t i = 0; i < count; ++i) write_frame(body, *own[i]);
}

}  // namespace

bool is_own_code(const void *caller) { return self != nullptr && linked() && caller_at(caller).own; }

void note_answer(Source source, const char *call, const std::string &answer, const void *caller) {
  static std::uint64_t event = 0;
  static std::uint32_t noted = 0;
  Thread *thread = me();
  if (thread == nullptr) return;
  const Inside inside(*thread);
  // Clocks are looked at often, and show what the event's time is.
  if (source == Source::CLOCK && ++caller_at(caller).looks > LOOKS_FIRST) return;
  if (event != times_let_go()) noted = 0;
  event = times_let_go();
  if (++noted > NOTES_PER_EVENT) return;
  Writer body;
  body.number(static_cast<std::uint32_t>(source));
  body.text(call);
  body.text(answer);
  if (source == Source::CLOCK) {
    body.number(1U);
    write_frame(body, caller_at(caller));
  } else {
    write_stack(body);
  }
  say(Say::DRAW, body);
}

void write_maker(Writer &body, const void *caller) {
  std::vector<const Caller *> own;
  if (caller_at(caller).own) {
    void *frames[DEPTH_OF_TEMPLATES];
    void **end = frames + backtrace(frames, DEPTH_OF_TEMPLATES);
    for (void **frame = std::find(frames, end, caller); frame != end; ++frame)
      if (const Caller &one = caller_at(*frame); one.own) own.push_back(&one);
  }
  body.number(static_cast<std::uint32_t>(own.size()));
  for (const Caller *one : own) write_frame(body, *one);
}

void note_sender(std::uint32_t id) {
  static auto *looks = new std::unordered_map<std::uint64_t, std::uint32_t>;
  if (!linked()) return;
  std::uint32_t &count = (*looks)[(std::uint64_t{id} << 32) | last_ready()];
  if (count > SENDERS_FIRST) return;
  Writer body;
  body.number(id);
  if (count++ < SENDERS_FIRST) {
    write_stack(body);
  } else {
    body.number(0U);  // from here on, its lines are not looked up
  }
  say(Say::SENDER, body);
}

}  // namespace rsltrace

using namespace rsltrace;

// The generators of libc are the program's own, seeds and all: they are noted, and left as they are.
#define RSLTRACE_DRAW(type, name)                                      \
  RSLTRACE_EXPORT type name() noexcept {                               \
    const type drawn = REAL(name)();                                   \
    RSLTRACE_NOTE(Source::RANDOM, #name "()", std::to_string(drawn));  \
    return drawn;                                                      \
  }

RSLTRACE_DRAW(int, rand)
RSLTRACE_DRAW(long, random)
RSLTRACE_DRAW(double, drand48)
RSLTRACE_DRAW(long, lrand48)
RSLTRACE_DRAW(long, mrand48)

RSLTRACE_EXPORT pid_t getpid() noexcept {
  const pid_t number = REAL(getpid)();
  RSLTRACE_NOTE(Source::PID, "getpid()", std::to_string(number));
  return number;
}
