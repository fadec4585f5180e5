// Chance comes from the job's seed.
#include <fcntl.h>
#include <stdio.h>
#include <sys/auxv.h>
#include <sys/mman.h>
#include <sys/random.h>
#include <unistd.h>

#include <cstdarg>
#include <cstdlib>
#include <cstring>
#include <random>
#include <string_view>
#include <utility>
#include <vector>

#include "call_sites.h"
#include "entropy.h"
#include "real.h"
#include "scheduler.h"

namespace rsltrace {
namespace {

// How much one who opens /dev/urandom finds there.
constexpr std::size_t DEVICE_BYTES = std::size_t{1} << 20;

constexpr std::uint64_t OF_START = 0x7374617274;

std::uint64_t draw() {
  static std::uint64_t state = seed();
  return split_mix(state);
}

void fill(void *out, std::size_t length) {
  auto *bytes = static_cast<char *>(out);
  while (length > 0) {
    const std::uint64_t word = draw();
    const std::size_t count = length < sizeof word ? length : sizeof word;
    std::memcpy(bytes, &word, count);
    bytes += count;
    length -= count;
  }
}

std::string hexadecimal(unsigned char byte) {
  char digits[3];
  std::snprintf(digits, sizeof digits, "%02x", byte);
  return digits;
}

// The first bytes, for the trace.
std::string shown(const void *drawn, std::size_t length) {
  constexpr std::size_t SHOWN_BYTES = 8;
  std::string text;
  for (std::size_t i = 0; i < length && i < SHOWN_BYTES; ++i)
    text += hexadecimal(static_cast<const unsigned char *>(drawn)[i]);
  return text + (length > SHOWN_BYTES ? "…" : "");
}

// A UUID of version 4, of RFC 4122.
void fill_uuid(unsigned char *out) {
  fill(out, 16);
  out[6] = static_cast<unsigned char>((out[6] & 0x0f) | 0x40);
  out[8] = static_cast<unsigned char>((out[8] & 0x3f) | 0x80);
}

// What the kernel would give to who reads this file, empty for files without chance.
std::string bytes_of(std::string_view path) {
  std::string bytes;
  if (path == "/dev/urandom" || path == "/dev/random") {
    bytes.resize(DEVICE_BYTES);
    fill(bytes.data(), bytes.size());
  } else if (path == "/proc/sys/kernel/random/uuid") {
    unsigned char uuid[16];
    fill_uuid(uuid);
    for (std::size_t i = 0; i < sizeof uuid; ++i)
      bytes += (i == 4 || i == 6 || i == 8 || i == 10 ? "-" : "") + hexadecimal(uuid[i]);
    bytes += '\n';
  }
  return bytes;
}

// A file with that; -1 if this process is not simulated or it cannot be made.
int open_device(const char *path, const void *caller) {
  if (path == nullptr || me() == nullptr) return -1;
  const std::string bytes = bytes_of(path);
  if (bytes.empty()) return -1;
  const int file = memfd_create("rsltrace-random", MFD_CLOEXEC);
  if (file < 0) return -1;
  if (REAL(write)(file, bytes.data(), bytes.size()) != static_cast<ssize_t>(bytes.size()) ||
      lseek(file, 0, SEEK_SET) != 0) {
    close(file);
    return -1;
  }
  if (is_own_code(caller)) note_answer(Source::RANDOM, path, shown(bytes.data(), bytes.size()), caller);
  return file;
}

}  // namespace

std::uint64_t split_mix(std::uint64_t &state) {
  std::uint64_t z = state += 0x9e3779b97f4a7c15;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
  z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
  return z ^ (z >> 31);
}

void exchange_start_bytes() {
  auto *bytes = reinterpret_cast<char *>(getauxval(AT_RANDOM));  // 16; libc has taken what it needs
  std::uint64_t state = seed() ^ OF_START;
  for (std::size_t i = 0; bytes != nullptr && i < 2; ++i) {
    const std::uint64_t word = split_mix(state);
    std::memcpy(bytes + i * sizeof word, &word, sizeof word);
  }
}

void fragment_heap(std::uint64_t seed) {
  constexpr std::size_t BLOCKS = 4000, SIZE_MAX_BYTES = 2000;
  std::vector<void *> blocks(BLOCKS);
  for (void *&block : blocks) {
    const std::size_t size = 1 + split_mix(seed) % SIZE_MAX_BYTES;
    block = std::malloc(size);
    if (block != nullptr) std::memset(block, 1 + static_cast<int>(split_mix(seed) % UINT8_MAX), size);
  }
  for (std::size_t left = BLOCKS; left > BLOCKS / 2; --left) {  // the others stay
    std::swap(blocks[split_mix(seed) % left], blocks[left - 1]);
    std::free(blocks[left - 1]);
  }
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT ssize_t getrandom(void *out, size_t length, unsigned flags) {
  if (me() == nullptr) return REAL(getrandom)(out, length, flags);
  fill(out, length);
  RSLTRACE_NOTE(Source::RANDOM, "getrandom()", shown(out, length));
  return static_cast<ssize_t>(length);
}

RSLTRACE_EXPORT int getentropy(void *out, size_t length) {
  if (me() == nullptr || length > 256) return REAL(getentropy)(out, length);
  fill(out, length);
  RSLTRACE_NOTE(Source::RANDOM, "getentropy()", shown(out, length));
  return 0;
}

// libc has these three since 2.36; a program that calls them was made for one that has them.
RSLTRACE_EXPORT std::uint32_t arc4random() noexcept {
  using Function = std::uint32_t();
  static auto *libc = reinterpret_cast<Function *>(real("arc4random"));
  if (me() == nullptr && libc != nullptr) return libc();
  const auto drawn = static_cast<std::uint32_t>(draw());
  RSLTRACE_NOTE(Source::RANDOM, "arc4random()", std::to_string(drawn));
  return drawn;
}

RSLTRACE_EXPORT void arc4random_buf(void *out, size_t length) noexcept {
  using Function = void(void *, size_t);
  static auto *libc = reinterpret_cast<Function *>(real("arc4random_buf"));
  if (me() == nullptr && libc != nullptr) return libc(out, length);
  fill(out, length);
  RSLTRACE_NOTE(Source::RANDOM, "arc4random_buf()", shown(out, length));
}

RSLTRACE_EXPORT std::uint32_t arc4random_uniform(std::uint32_t bound) noexcept {
  if (bound < 2) return 0;
  const std::uint32_t least = -bound % bound;  // so that all results are equally likely
  std::uint32_t drawn;
  do drawn = arc4random();
  while (drawn < least);
  RSLTRACE_NOTE(Source::RANDOM, "arc4random_uniform()", std::to_string(drawn % bound));
  return drawn % bound;
}

// std::random_device asks the processor (rdrand), or opens the device.
RSLTRACE_EXPORT unsigned rsltrace_random_device(std::random_device *device) __asm__("_ZNSt13random_device9_M_getvalEv");

RSLTRACE_EXPORT unsigned rsltrace_random_device(std::random_device *device) {
  using Function = unsigned(std::random_device *);
  static auto *original = reinterpret_cast<Function *>(real("_ZNSt13random_device9_M_getvalEv"));
  if (me() == nullptr) return original(device);
  const auto drawn = static_cast<unsigned>(draw());
  RSLTRACE_NOTE(Source::RANDOM, "std::random_device()", std::to_string(drawn));
  return drawn;
}

// libuuid mixes process numbers into what it draws.
RSLTRACE_EXPORT void uuid_generate_random(unsigned char *out) {
  using Function = void(unsigned char *);
  static auto *original = reinterpret_cast<Function *>(real("uuid_generate_random"));
  if (me() == nullptr && original != nullptr) return original(out);
  fill_uuid(out);
  RSLTRACE_NOTE(Source::RANDOM, "uuid_generate_random()", shown(out, 16));
}

RSLTRACE_EXPORT void uuid_generate(unsigned char *out) { uuid_generate_random(out); }

#define RSLTRACE_OPEN(name, ...)                                            \
  if (const int file = open_device(path, __builtin_return_address(0)); file >= 0) return file; \
  va_list rest;                                                             \
  va_start(rest, flags);                                                    \
  const mode_t mode = (flags & (O_CREAT | O_TMPFILE)) != 0 ? va_arg(rest, mode_t) : 0; \
  va_end(rest);                                                             \
  return REAL(name)(__VA_ARGS__, flags, mode)

RSLTRACE_EXPORT int open(const char *path, int flags, ...) { RSLTRACE_OPEN(open, path); }
RSLTRACE_EXPORT int open64(const char *path, int flags, ...) { RSLTRACE_OPEN(open64, path); }
RSLTRACE_EXPORT int openat(int folder, const char *path, int flags, ...) { RSLTRACE_OPEN(openat, folder, path); }
RSLTRACE_EXPORT int openat64(int folder, const char *path, int flags, ...) { RSLTRACE_OPEN(openat64, folder, path); }

RSLTRACE_EXPORT FILE *fopen(const char *path, const char *mode) {
  const int file = open_device(path, __builtin_return_address(0));
  return file >= 0 ? fdopen(file, "r") : REAL(fopen)(path, mode);
}

RSLTRACE_EXPORT FILE *fopen64(const char *path, const char *mode) {
  const int file = open_device(path, __builtin_return_address(0));
  return file >= 0 ? fdopen(file, "r") : REAL(fopen64)(path, mode);
}
