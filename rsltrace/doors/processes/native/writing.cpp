// Writing to a pipe or socket of the process's own that is full: who writes waits for who reads.
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>

#include "files.h"
#include "real.h"

using namespace rsltrace;

namespace {

constexpr std::size_t PART = PIPE_BUF;  // what is taken at once where there is any room

// How much of `length` may be written at a time without blocking in the kernel; 0: that is no
// matter of this process alone, or blocks in no case.
std::size_t part_of(int fd, std::size_t length) {
  struct stat found {};
  if (fstat(fd, &found) != 0 || (fcntl(fd, F_GETFL) & O_NONBLOCK) != 0) return 0;
  int type = SOCK_STREAM;
  socklen_t size = sizeof type;
  if (S_ISSOCK(found.st_mode)) {
    if (getsockopt(fd, SOL_SOCKET, SO_TYPE, &type, &size) != 0) return 0;
  } else if (!S_ISFIFO(found.st_mode)) {
    return 0;
  }
  std::string where;
  if (comes_from_outside(fd, where)) return 0;
  return type == SOCK_STREAM ? PART : length;  // a datagram is one
}

template <typename Put>
ssize_t put(int fd, const void *data, std::size_t length, const char *what, Put put_now) {
  Thread *thread = me();
  if (thread == nullptr || all().size() < 2) return put_now(data, length);
  Files files{{{fd, POLLOUT, 0}}, false, false};
  if (length <= PART && REAL(poll)(files.list.data(), 1, 0) != 0) return put_now(data, length);
  const std::size_t part = part_of(fd, length);
  if (part == 0) return put_now(data, length);
  std::size_t done = 0;
  do {
    while (REAL(poll)(files.list.data(), 1, 0) == 0)
      if (wait_for_files(*thread, files, NEVER_NS, what) == Outcome::INTERRUPTED)
        return done > 0 ? static_cast<ssize_t>(done) : (errno = EINTR, -1);
    const ssize_t taken = put_now(static_cast<const char *>(data) + done, std::min(part, length - done));
    if (taken < 0) return done > 0 ? static_cast<ssize_t>(done) : -1;
    done += static_cast<std::size_t>(taken);
  } while (done < length);
  return static_cast<ssize_t>(done);
}

}  // namespace

RSLTRACE_EXPORT ssize_t write(int fd, const void *data, size_t length) {
  return put(fd, data, length, "write", [fd](const void *from, size_t size) { return REAL(write)(fd, from, size); });
}

RSLTRACE_EXPORT ssize_t send(int fd, const void *data, size_t length, int flags) {
  if ((flags & MSG_DONTWAIT) != 0) return REAL(send)(fd, data, length, flags);
  return put(fd, data, length, "send",
             [fd, flags](const void *from, size_t size) { return REAL(send)(fd, from, size, flags); });
}
