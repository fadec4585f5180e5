// See call_sites.h. What a caller is, is found out once for each place; stacks are unwound only for
// the first draws and messages of each callback.
#include "call_sites.h"

#include <dlfcn.h>
#include <execinfo.h>
#include <limits.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#include "python_symbols.h"
#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

constexpr int DEPTH = 16;
constexpr int DEPTH_OF_TEMPLATES = 64;  // of rclcpp, unoptimized
constexpr std::uint32_t NOTES_PER_EVENT = 100;  // as many as the guard keeps
constexpr std::uint32_t DRAWS_FIRST = 4;        // of an event, at each place: then only the last one
constexpr std::size_t RECORD_BYTES = 4096;  // more than most paths need
constexpr std::uint32_t LOOKS_FIRST = 32;       // at clocks, from each place
constexpr std::uint32_t SENDERS_FIRST = 32;     // as adapters/rclpy/concurrency/code_lines.py

const char *const LIBRARIES[] = {"librcl.so", "librclcpp.so", "libc.so.6", "libstdc++.so.6"};

}  // namespace

bool is_library(const Dl_info &info) {
  Dl_info here{};
  if (dladdr(reinterpret_cast<const void *>(&note_sender), &here) != 0 && here.dli_fbase == info.dli_fbase) return true;
  const std::string_view file = info.dli_fname;
  const auto slash = file.rfind('/');
  if (slash == std::string_view::npos || file.compare(slash + 1, 3, "lib") != 0) return false;
  if (slash > 5 && file.substr(slash - 5, 5) == ".libs") return true;  // what a wheel brings along
  char path[PATH_MAX];
  for (const char *name : LIBRARIES) {
    std::snprintf(path, sizeof path, "%.*s%s", static_cast<int>(slash + 1), file.data(), name);
    if (access(path, F_OK) == 0) return true;
  }
  return false;
}

namespace {

// The path of a file that may be unloaded. Not in the heap either; "" if there are too many.
const char *kept(const char *path) {
  static char paths[16 * PATH_MAX];
  static char *end = paths;
  for (char *one = paths; one < end; one += strlen(one) + 1)
    if (strcmp(one, path) == 0) return one;
  const std::size_t size = strlen(path) + 1;
  if (end + size > paths + sizeof paths) return "";
  return static_cast<char *>(memcpy(std::exchange(end, end + size), path, size));
}

// Of libraries no more is kept.
struct Caller {
  bool own = false;
  std::uint32_t event = 0;  // in which it drew
  const char *file = "";
  std::uint64_t offset = 0;  // of the call, not of where it returns to
  std::uint32_t calls = 0;   // of a clock; draws of the event
};

// The latest draw of a place, if it is none of the event's first.
struct Draw {
  Caller *caller;
  Source source;
  const char *call;
  std::string answer;
};
std::vector<Draw> &latest_draws() {
  static auto *draws = new std::vector<Draw>;
  return *draws;
}

// dladdr goes through all symbols of a library: once for each place.
Caller &caller_at(const void *address) {
  static auto *known = new std::unordered_map<const void *, Caller>;
  const auto [found, is_new] = known->try_emplace(address);
  Dl_info info{};
  if (!is_new || dladdr(address, &info) == 0 || info.dli_fname == nullptr) return found->second;
  const auto offset = static_cast<const char *>(address) - 1 - static_cast<char *>(info.dli_fbase);
  if (!is_library(info)) found->second = {true, 0, kept(info.dli_fname), static_cast<std::uint64_t>(offset)};
  return found->second;
}

void write_frame(Writer &body, const Caller &caller) {
  body.blob(caller.file, strlen(caller.file));
  body.number(caller.offset);
}

void write_caller(Writer &body, const Caller &caller) {
  body.number(1U);
  write_frame(body, caller);
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

namespace {

// As long for any path.
Writer start_of_paths() {
  Writer body;
  body.bytes.reserve(RECORD_BYTES);
  return body;
}

Writer start_of_record(Source source, std::uint32_t calls, const char *call, const std::string &answer) {
  Writer body = start_of_paths();
  body.number(static_cast<std::uint32_t>(source));
  body.number(calls);
  body.text(call);
  body.text(answer);
  return body;
}

void begin_event(Caller &caller) {
  const auto now = static_cast<std::uint32_t>(times_let_go());
  if (std::exchange(caller.event, now) != now) caller.calls = 0;
}

void keep_latest(Draw draw) {
  auto &draws = latest_draws();
  for (Draw &one : draws)
    if (one.caller == draw.caller) return std::swap(one, draw);
  draws.push_back(std::move(draw));
}

}  // namespace

void note_answer(Source source, const char *call, const std::string &answer, const void *where) {
  static std::uint64_t event = 0;
  static std::uint32_t noted = 0;
  Thread *thread = me();
  if (thread == nullptr) return;
  const Inside inside(*thread);
  Caller &caller = caller_at(where);
  const bool is_clock = source == Source::CLOCK;
  if (!is_clock) begin_event(caller);
  // Clocks are looked at often, and show what the event's time is.
  if (++caller.calls > LOOKS_FIRST && is_clock) return;
  if (caller.calls > DRAWS_FIRST && !is_clock) return keep_latest({&caller, source, call, answer});
  if (event != times_let_go()) noted = 0;
  event = times_let_go();
  if (++noted > NOTES_PER_EVENT) return;
  Writer body = start_of_record(source, 1, call, answer);
  if (is_clock) {
    write_caller(body, caller);
  } else {
    write_stack(body);
  }
  say(Say::DRAW, body);
}

void note_variable(const char *name, const char *value, const void *where) {
  Thread *thread = me();
  if (thread == nullptr || has_python()) return;  // which reads many as it starts
  const Inside inside(*thread);
  Caller &caller = caller_at(where);
  begin_event(caller);
  if (++caller.calls > DRAWS_FIRST) return;
  Writer body = start_of_paths();
  body.number(static_cast<std::uint32_t>(Source::VARIABLE));
  body.number(1U);
  body.blob(name, strnlen(name, RECORD_BYTES / 8));
  body.number(value == nullptr ? 0U : 1U);
  body.blob(value, value == nullptr ? 0 : strnlen(value, RECORD_BYTES / 8));
  write_stack(body);
  say(Say::DRAW, body);
}

void note_latest_draws() {
  for (const Draw &draw : latest_draws()) {
    const std::string answer = "call " + std::to_string(draw.caller->calls) + ": " + draw.answer;
    Writer body = start_of_record(draw.source, draw.caller->calls - DRAWS_FIRST, draw.call, answer);
    write_caller(body, *draw.caller);
    say(Say::DRAW, body);
  }
  latest_draws().clear();
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
  Writer body = start_of_paths();
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

RSLTRACE_EXPORT char *getenv(const char *name) noexcept {
  char *const value = REAL(getenv)(name);
  const void *caller = __builtin_return_address(0);
  if (strncmp(name, "PYTHON", 6) == 0) rsltrace_start_python(caller);
  if (is_own_code(caller)) note_variable(name, value, caller);
  return value;
}
