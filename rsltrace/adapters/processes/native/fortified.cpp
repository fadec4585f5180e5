// What programs call that were built with _FORTIFY_SOURCE (packages of distributions are): functions
// of ours that are also given the size of the memory they use.
#include <fcntl.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include "link.h"

extern "C" [[noreturn]] void __chk_fail() noexcept;  // of libc

namespace {

void check(std::size_t wanted, std::size_t size) {
  if (wanted > size) __chk_fail();
}

}  // namespace

RSLTRACE_EXPORT ssize_t __read_chk(int fd, void *out, size_t length, size_t size) {
  check(length, size);
  return read(fd, out, length);
}

RSLTRACE_EXPORT ssize_t __recv_chk(int fd, void *out, size_t length, size_t size, int flags) {
  check(length, size);
  return recv(fd, out, length, flags);
}

RSLTRACE_EXPORT ssize_t __recvfrom_chk(int fd, void *out, size_t length, size_t size, int flags, sockaddr *from,
                                       socklen_t *from_size) {
  check(length, size);
  return recvfrom(fd, out, length, flags, from, from_size);
}

RSLTRACE_EXPORT int __poll_chk(pollfd *fds, nfds_t count, int timeout, size_t size) {
  check(count, size / sizeof *fds);
  return poll(fds, count, timeout);
}

RSLTRACE_EXPORT int __ppoll_chk(pollfd *fds, nfds_t count, const timespec *timeout, const sigset_t *mask,
                                size_t size) {
  check(count, size / sizeof *fds);
  return ppoll(fds, count, timeout, mask);
}

// Without a mode: libc refuses flags that need one.
RSLTRACE_EXPORT int __open_2(const char *path, int flags) { return open(path, flags); }
RSLTRACE_EXPORT int __open64_2(const char *path, int flags) { return open64(path, flags); }
RSLTRACE_EXPORT int __openat_2(int folder, const char *path, int flags) { return openat(folder, path, flags); }
RSLTRACE_EXPORT int __openat64_2(int folder, const char *path, int flags) { return openat64(folder, path, flags); }
