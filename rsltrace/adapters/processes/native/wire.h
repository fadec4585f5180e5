// What the library and the loop say to each other, as bytes: little-endian numbers, texts and blobs
// with their length before them. The other side is ../wire.py.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

namespace rsltrace {

// From the library to the loop. A batch is records of (kind, length, body) in memory that both see
// (shared.h); the last record says what the process wants: to be answered, or to wait.
enum class Say : std::uint32_t {
  HELLO = 1,
  NODE,
  PUBLISHER,
  SUBSCRIPTION,
  SERVICE,
  CLIENT,
  TIMER,
  GONE,
  PUBLISH,
  REQUEST,
  RESPONSE,
  LOG,
  REPORT,
  TIMER_PASSED,
  TIMER_NEXT,
  WAIT_SET,
  WAIT,
  TAKE,
  GID,
  QOS,
  MATCHED,
  GRAPH,
  ALIVE,
  QOS_EVENT,
  FOLLOWS,
  CALLBACK,
  TIMER_OF,
  CLOCK_OWNER,
  CLOCK,
  READY,
  DROPPED,
  UNSEEN,
  DRAW,
  SENDER,
  CRASH,
};

// From the loop to the library, in other memory that both see: what comes after (length, kind).
enum class Told : std::uint32_t { GO = 1, ANSWER, STOP, KILL };

class Writer {
 public:
  void number(std::uint32_t value) { raw(&value, sizeof value); }
  void number(std::int32_t value) { raw(&value, sizeof value); }
  void number(std::uint64_t value) { raw(&value, sizeof value); }
  void number(std::int64_t value) { raw(&value, sizeof value); }
  void blob(const void *data, std::size_t size) {
    number(static_cast<std::uint32_t>(size));
    raw(data, size);
  }
  void text(const std::string &value) { blob(value.data(), value.size()); }
  void raw(const void *data, std::size_t size) {
    // Not insert(): g++ 12 warns of a move of what an empty vector does not have.
    const auto before = bytes.size();
    bytes.resize(before + size);
    std::copy_n(static_cast<const std::uint8_t *>(data), size, bytes.begin() + before);
  }
  std::vector<std::uint8_t> bytes;
};

class Reader {
 public:
  Reader(const std::uint8_t *data, std::size_t size) : next_(data), end_(data + size) {}
  template <typename Number>
  Number number() {
    Number value{};
    if (need(sizeof value)) {
      std::memcpy(&value, next_, sizeof value);
      next_ += sizeof value;
    }
    return value;
  }
  std::vector<std::uint8_t> blob() {
    const auto size = number<std::uint32_t>();
    if (!need(size)) return {};
    std::vector<std::uint8_t> data(next_, next_ + size);
    next_ += size;
    return data;
  }
  std::string text() {
    const auto data = blob();
    return std::string(data.begin(), data.end());
  }
  void raw(void *target, std::size_t size) {
    if (!need(size)) return;
    std::memcpy(target, next_, size);
    next_ += size;
  }
  bool whole() const { return whole_; }

 private:
  bool need(std::size_t size) {
    whole_ = whole_ && size <= static_cast<std::size_t>(end_ - next_);
    return whole_;
  }
  const std::uint8_t *next_;
  const std::uint8_t *end_;
  bool whole_ = true;
};

}  // namespace rsltrace
