// Memory that the loop sees, too. What either says lies there until the other has taken it: what a
// process has said is not lost if it is killed.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>

namespace rsltrace {

// A file in memory, mapped. Plain data: it is there before constructors run and after destructors.
class Shared {
 public:
  // Map a file; false if that is none.
  bool open(int fd);
  // Have room for so many bytes in all; false if there is no memory.
  bool grow(std::size_t size);
  // Map what the loop has made it grow by.
  bool look_again();
  // Nothing of it remains in a forked copy of this process.
  void forget();
  std::uint8_t *data = nullptr;
  std::size_t size = 0;

 private:
  bool map(std::size_t size);
  int fd_ = -1;
};

}  // namespace rsltrace
