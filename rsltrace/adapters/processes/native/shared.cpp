#include "shared.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

namespace rsltrace {

bool Shared::open(int fd) {
  fd_ = fd;
  fcntl(fd, F_SETFD, FD_CLOEXEC);
  return look_again();
}

bool Shared::look_again() {
  struct stat found {};
  return fstat(fd_, &found) == 0 && map(static_cast<std::size_t>(found.st_size));
}

bool Shared::grow(std::size_t size) {
  return ftruncate(fd_, static_cast<off_t>(size)) == 0 && map(size);
}

bool Shared::map(std::size_t wanted) {
  void *found = data == nullptr
                    ? mmap(nullptr, wanted, PROT_READ | PROT_WRITE, MAP_SHARED, fd_, 0)
                    : mremap(data, size, wanted, MREMAP_MAYMOVE);
  if (found == MAP_FAILED) return false;
  data = static_cast<std::uint8_t *>(found);
  size = wanted;
  madvise(found, wanted, MADV_DONTFORK);
  return true;
}

void Shared::forget() {
  if (fd_ >= 0) syscall(SYS_close, fd_);
  fd_ = -1;
  data = nullptr;
  size = 0;
}

}  // namespace rsltrace
