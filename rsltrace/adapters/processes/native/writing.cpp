// Writing to a pipe or socket of the process's own that is full: who writes waits for who reads.
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/uio.h>
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

// Write by `put_now(done, size)`: so many bytes, after those that are done.
template <typename Put>
ssize_t put(int fd, std::size_t length, const char *what, Put put_now) {
  Thread *thread = me();
  if (thread == nullptr || all().size() < 2) return put_now(0, length);
  Files files{{{fd, POLLOUT, 0}}, false, false};
  if (length <= PART && REAL(poll)(files.list.data(), 1, 0) != 0) return put_now(0, length);
  const std::size_t part = part_of(fd, length);
  if (part == 0) return put_now(0, length);
  std::size_t done = 0;
  do {
    while (REAL(poll)(files.list.data(), 1, 0) == 0)
      if (wait_for_files(*thread, files, NEVER_NS, what) == Outcome::INTERRUPTED)
        return done > 0 ? static_cast<ssize_t>(done) : (errno = EINTR, -1);
    const ssize_t taken = put_now(done, std::min(part, length - done));
    if (taken < 0) return done > 0 ? static_cast<ssize_t>(done) : -1;
    done += static_cast<std::size_t>(taken);
  } while (done < length);
  return static_cast<ssize_t>(done);
}

const char *from(const void *data, std::size_t done) { return static_cast<const char *>(data) + done; }

// Blocks of memory that are written one after another, and `size` bytes of them after `done`.
using Blocks = std::vector<iovec>;

std::size_t length_of(const iovec *blocks, std::size_t count) {
  std::size_t length = 0;
  for (std::size_t i = 0; i < count; ++i) length += blocks[i].iov_len;
  return length;
}

Blocks part_of(const iovec *blocks, std::size_t count, std::size_t done, std::size_t size) {
  Blocks part;
  for (std::size_t i = 0; i < count && size > 0; ++i) {
    const std::size_t skipped = std::min(done, blocks[i].iov_len);
    const std::size_t taken = std::min(size, blocks[i].iov_len - skipped);
    done -= skipped;
    size -= taken;
    if (taken > 0) part.push_back({static_cast<char *>(blocks[i].iov_base) + skipped, taken});
  }
  return part;
}

}  // namespace

RSLTRACE_EXPORT ssize_t write(int fd, const void *data, size_t length) {
  return put(fd, length, "write",
             [=](std::size_t done, std::size_t size) { return REAL(write)(fd, from(data, done), size); });
}

RSLTRACE_EXPORT ssize_t writev(int fd, const iovec *blocks, int count) {
  if (count <= 0 || count > IOV_MAX) return REAL(writev)(fd, blocks, count);
  const auto number = static_cast<std::size_t>(count);
  const std::size_t length = length_of(blocks, number);
  return put(fd, length, "writev", [=](std::size_t done, std::size_t size) {
    if (size == length) return REAL(writev)(fd, blocks, count);
    const Blocks part = part_of(blocks, number, done, size);
    return REAL(writev)(fd, part.data(), static_cast<int>(part.size()));
  });
}

RSLTRACE_EXPORT ssize_t send(int fd, const void *data, size_t length, int flags) {
  if ((flags & MSG_DONTWAIT) != 0) return REAL(send)(fd, data, length, flags);
  return put(fd, length, "send",
             [=](std::size_t done, std::size_t size) { return REAL(send)(fd, from(data, done), size, flags); });
}

RSLTRACE_EXPORT ssize_t sendto(int fd, const void *data, size_t length, int flags, const sockaddr *to,
                               socklen_t to_size) {
  if ((flags & MSG_DONTWAIT) != 0) return REAL(sendto)(fd, data, length, flags, to, to_size);
  return put(fd, length, "sendto", [=](std::size_t done, std::size_t size) {
    return REAL(sendto)(fd, from(data, done), size, flags, to, to_size);
  });
}

RSLTRACE_EXPORT ssize_t sendmsg(int fd, const msghdr *message, int flags) {
  if ((flags & MSG_DONTWAIT) != 0) return REAL(sendmsg)(fd, message, flags);
  const std::size_t length = length_of(message->msg_iov, message->msg_iovlen);
  return put(fd, length, "sendmsg", [=](std::size_t done, std::size_t size) {
    if (size == length) return REAL(sendmsg)(fd, message, flags);
    Blocks part = part_of(message->msg_iov, message->msg_iovlen, done, size);
    msghdr head = *message;
    head.msg_iov = part.data();
    head.msg_iovlen = part.size();
    if (done > 0) head.msg_control = nullptr, head.msg_controllen = 0;  // descriptors go with the first part
    return REAL(sendmsg)(fd, &head, flags);
  });
}
