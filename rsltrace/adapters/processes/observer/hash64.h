// XXH3 with 64 bits and no seed, as trace/chain.py has it from Python's xxhash.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

namespace rsltrace {

namespace xxh3 {

constexpr std::uint64_t P32_1 = 0x9E3779B1, P32_2 = 0x85EBCA77, P32_3 = 0xC2B2AE3D;
constexpr std::uint64_t P64_1 = 0x9E3779B185EBCA87, P64_2 = 0xC2B2AE3D27D4EB4F,
                        P64_3 = 0x165667B19E3779F9, P64_4 = 0x85EBCA77C2B2AE63,
                        P64_5 = 0x27D4EB2F165667C5;
constexpr std::size_t STRIPE = 64, STRIPES = 16, BLOCK = STRIPE * STRIPES;
alignas(8) constexpr std::uint8_t SECRET[192] = {
    0xb8, 0xfe, 0x6c, 0x39, 0x23, 0xa4, 0x4b, 0xbe, 0x7c, 0x01, 0x81, 0x2c, 0xf7, 0x21, 0xad, 0x1c,
    0xde, 0xd4, 0x6d, 0xe9, 0x83, 0x90, 0x97, 0xdb, 0x72, 0x40, 0xa4, 0xa4, 0xb7, 0xb3, 0x67, 0x1f,
    0xcb, 0x79, 0xe6, 0x4e, 0xcc, 0xc0, 0xe5, 0x78, 0x82, 0x5a, 0xd0, 0x7d, 0xcc, 0xff, 0x72, 0x21,
    0xb8, 0x08, 0x46, 0x74, 0xf7, 0x43, 0x24, 0x8e, 0xe0, 0x35, 0x90, 0xe6, 0x81, 0x3a, 0x26, 0x4c,
    0x3c, 0x28, 0x52, 0xbb, 0x91, 0xc3, 0x00, 0xcb, 0x88, 0xd0, 0x65, 0x8b, 0x1b, 0x53, 0x2e, 0xa3,
    0x71, 0x64, 0x48, 0x97, 0xa2, 0x0d, 0xf9, 0x4e, 0x38, 0x19, 0xef, 0x46, 0xa9, 0xde, 0xac, 0xd8,
    0xa8, 0xfa, 0x76, 0x3f, 0xe3, 0x9c, 0x34, 0x3f, 0xf9, 0xdc, 0xbb, 0xc7, 0xc7, 0x0b, 0x4f, 0x1d,
    0x8a, 0x51, 0xe0, 0x4b, 0xcd, 0xb4, 0x59, 0x31, 0xc8, 0x9f, 0x7e, 0xc9, 0xd9, 0x78, 0x73, 0x64,
    0xea, 0xc5, 0xac, 0x83, 0x34, 0xd3, 0xeb, 0xc3, 0xc5, 0x81, 0xa0, 0xff, 0xfa, 0x13, 0x63, 0xeb,
    0x17, 0x0d, 0xdd, 0x51, 0xb7, 0xf0, 0xda, 0x49, 0xd3, 0x16, 0x55, 0x26, 0x29, 0xd4, 0x68, 0x9e,
    0x2b, 0x16, 0xbe, 0x58, 0x7d, 0x47, 0xa1, 0xfc, 0x8f, 0xf8, 0xb8, 0xd1, 0x7a, 0xd0, 0x31, 0xce,
    0x45, 0xcb, 0x3a, 0x8f, 0x95, 0x16, 0x04, 0x28, 0xaf, 0xd7, 0xfb, 0xca, 0xbb, 0x4b, 0x40, 0x7e,
};

template <typename Number = std::uint64_t>
std::uint64_t at(const std::uint8_t *data) {
  Number value;
  std::memcpy(&value, data, sizeof value);
  return value;
}

inline std::uint64_t folded(std::uint64_t a, std::uint64_t b) {
  const auto product = static_cast<unsigned __int128>(a) * b;
  return static_cast<std::uint64_t>(product) ^ static_cast<std::uint64_t>(product >> 64);
}

inline std::uint64_t mixed(const std::uint8_t *data, const std::uint8_t *secret) {
  return folded(at(data) ^ at(secret), at(data + 8) ^ at(secret + 8));
}

inline std::uint64_t turned(std::uint64_t value, int by) { return value << by | value >> (64 - by); }

inline std::uint64_t finished(std::uint64_t hash) {
  hash = (hash ^ hash >> 37) * 0x165667919E3779F9;
  return hash ^ hash >> 32;
}

inline std::uint64_t finished_short(std::uint64_t hash) {
  hash = (hash ^ hash >> 33) * P64_2;
  hash = (hash ^ hash >> 29) * P64_3;
  return hash ^ hash >> 32;
}

inline std::uint64_t up_to_16(const std::uint8_t *data, std::size_t size) {
  if (size > 8) {
    const std::uint64_t low = at(data) ^ at(SECRET + 24) ^ at(SECRET + 32);
    const std::uint64_t high = at(data + size - 8) ^ at(SECRET + 40) ^ at(SECRET + 48);
    return finished(size + __builtin_bswap64(low) + high + folded(low, high));
  }
  if (size >= 4) {
    std::uint64_t hash = at<std::uint32_t>(data + size - 4) + (at<std::uint32_t>(data) << 32);
    hash ^= at(SECRET + 8) ^ at(SECRET + 16);
    hash = (hash ^ turned(hash, 49) ^ turned(hash, 24)) * 0x9FB21C651E98DF25;
    hash = (hash ^ ((hash >> 35) + size)) * 0x9FB21C651E98DF25;
    return hash ^ hash >> 28;
  }
  if (size == 0) return finished_short(at(SECRET + 56) ^ at(SECRET + 64));
  const std::uint64_t all = std::uint64_t{data[0]} << 16 | std::uint64_t{data[size / 2]} << 24 |
                            data[size - 1] | size << 8;
  return finished_short(all ^ at<std::uint32_t>(SECRET) ^ at<std::uint32_t>(SECRET + 4));
}

inline std::uint64_t up_to_240(const std::uint8_t *data, std::size_t size) {
  std::uint64_t sum = size * P64_1;
  if (size <= 128) {
    for (std::size_t i = 0; i * 32 < size; ++i) {
      sum += mixed(data + 16 * i, SECRET + 32 * i);
      sum += mixed(data + size - 16 * (i + 1), SECRET + 32 * i + 16);
    }
    return finished(sum);
  }
  for (std::size_t i = 0; i < 8; ++i) sum += mixed(data + 16 * i, SECRET + 16 * i);
  sum = finished(sum);
  for (std::size_t i = 8; i < size / 16; ++i) sum += mixed(data + 16 * i, SECRET + 16 * i - 125);
  return finished(sum + mixed(data + size - 16, SECRET + 119));
}

inline void add_stripe(std::uint64_t *sums, const std::uint8_t *data, const std::uint8_t *secret) {
  for (int i = 0; i < 8; ++i) {
    const std::uint64_t value = at(data + 8 * i), key = value ^ at(secret + 8 * i);
    sums[i ^ 1] += value;
    sums[i] += (key & 0xFFFFFFFF) * (key >> 32);
  }
}

inline std::uint64_t long_one(const std::uint8_t *data, std::size_t size) {
  std::uint64_t sums[8] = {P32_3, P64_1, P64_2, P64_3, P64_4, P32_2, P64_5, P32_1};
  const std::uint8_t *last = SECRET + sizeof SECRET - STRIPE;
  for (std::size_t i = 0; i < (size - 1) / STRIPE; ++i) {
    add_stripe(sums, data + i * STRIPE, SECRET + 8 * (i % STRIPES));
    for (int k = 0; (i + 1) % STRIPES == 0 && k < 8; ++k)
      sums[k] = (sums[k] ^ sums[k] >> 47 ^ at(last + 8 * k)) * P32_1;
  }
  add_stripe(sums, data + size - STRIPE, last - 7);
  std::uint64_t sum = size * P64_1;
  for (int i = 0; i < 8; i += 2)
    sum += folded(sums[i] ^ at(SECRET + 11 + 8 * i), sums[i + 1] ^ at(SECRET + 19 + 8 * i));
  return finished(sum);
}

}  // namespace xxh3

inline std::uint64_t hash64(const std::uint8_t *data, std::size_t size) {
  if (size <= 16) return xxh3::up_to_16(data, size);
  return size <= 240 ? xxh3::up_to_240(data, size) : xxh3::long_one(data, size);
}

}  // namespace rsltrace
