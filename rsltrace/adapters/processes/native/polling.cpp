// poll, select, epoll_wait, and reading from what has nothing to read yet; waiting for signals.
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <unistd.h>

#include "files.h"
#include "real.h"

using namespace rsltrace;

namespace {

std::int64_t deadline_in(std::int64_t milliseconds) {
  return milliseconds < 0 ? NEVER_NS : now_ns() + milliseconds * 1'000'000;
}

class Masked {  // the signal mask that ppoll and its like wait with
 public:
  explicit Masked(const sigset_t *mask) : masked_(mask != nullptr) {
    if (masked_) pthread_sigmask(SIG_SETMASK, mask, &before_);
  }
  ~Masked() {
    if (masked_) pthread_sigmask(SIG_SETMASK, &before_, nullptr);
  }

 private:
  bool masked_;
  sigset_t before_;
};

// `look_now` is the real call without waiting; 0 means nothing yet.
template <typename Look>
int wait_until(Thread &thread, std::vector<pollfd> list, std::int64_t deadline_ns, const sigset_t *mask,
               const char *what, Look look_now) {
  fire_timer_files();
  int result = look_now();
  if (result != 0) return result;
  const bool waits = deadline_ns > now_ns();
  if (!waits) look(thread, 100);
  const Masked masked(mask);
  Files files{std::move(list), false, false};
  while (result == 0 && deadline_ns > now_ns()) {
    const Outcome outcome = wait_for_files(thread, files, deadline_ns, what);
    result = look_now();
    if (result == 0 && outcome == Outcome::INTERRUPTED) return errno = EINTR, -1;
  }
  return result;
}

int poll_until(Thread &thread, pollfd *fds, nfds_t count, std::int64_t deadline_ns, const sigset_t *mask,
               const char *what) {
  return wait_until(thread, {fds, fds + count}, deadline_ns, mask, what,
                    [&] { return REAL(poll)(fds, count, 0); });
}

int select_until(Thread &thread, int count, fd_set *sets[3], std::int64_t deadline_ns, const sigset_t *mask,
                 const char *what) {
  constexpr short EVENTS[3] = {POLLIN, POLLOUT, POLLPRI};
  fd_set asked[3];
  std::vector<pollfd> list;
  for (int i = 0; i < 3; ++i) {
    if (sets[i] == nullptr) continue;
    asked[i] = *sets[i];
    for (int fd = 0; fd < count; ++fd)
      if (FD_ISSET(fd, sets[i])) list.push_back({fd, EVENTS[i], 0});
  }
  return wait_until(thread, std::move(list), deadline_ns, mask, what, [&] {
    for (int i = 0; i < 3; ++i)
      if (sets[i] != nullptr) *sets[i] = asked[i];
    timeval none{0, 0};
    return REAL(select)(count, sets[0], sets[1], sets[2], &none);
  });
}

int epoll_until(Thread &thread, int epoll, epoll_event *events, int count, std::int64_t deadline_ns,
                const sigset_t *mask, const char *what) {
  return wait_until(thread, {{epoll, POLLIN, 0}}, deadline_ns, mask, what,
                    [&] { return REAL(epoll_wait)(epoll, events, count, 0); });
}

// Before a call that would block until there is something to read. False: errno says why not.
bool readable(int fd, const char *what, int flags = 0) {
  Thread *thread = me();
  if (thread == nullptr) return true;
  fire_timer_files();
  pollfd one{fd, POLLIN, 0};
  if (REAL(poll)(&one, 1, 0) != 0) return true;
  if ((flags & MSG_DONTWAIT) != 0 || (fcntl(fd, F_GETFL) & O_NONBLOCK) != 0) {
    look(*thread, 100);
    return true;
  }
  timeval limit{};
  socklen_t length = sizeof limit;
  std::int64_t deadline_ns = NEVER_NS;
  if (getsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, &length) == 0 && (limit.tv_sec != 0 || limit.tv_usec != 0))
    deadline_ns = deadline_after({limit.tv_sec, limit.tv_usec * 1000});
  const int ready = poll_until(*thread, &one, 1, deadline_ns, nullptr, what);
  if (ready == 0) errno = EAGAIN;
  return ready > 0;
}

}  // namespace

RSLTRACE_EXPORT int poll(pollfd *fds, nfds_t count, int timeout) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(poll)(fds, count, timeout);
  return poll_until(*thread, fds, count, deadline_in(timeout), nullptr, "poll");
}

RSLTRACE_EXPORT int ppoll(pollfd *fds, nfds_t count, const timespec *timeout, const sigset_t *mask) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(ppoll)(fds, count, timeout, mask);
  if (timeout != nullptr && !valid(timeout)) return errno = EINVAL, -1;
  return poll_until(*thread, fds, count, timeout == nullptr ? NEVER_NS : deadline_after(*timeout), mask, "ppoll");
}

RSLTRACE_EXPORT int select(int count, fd_set *in, fd_set *out, fd_set *odd, timeval *timeout) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(select)(count, in, out, odd, timeout);
  fd_set *sets[3] = {in, out, odd};
  const std::int64_t deadline_ns =
      timeout == nullptr ? NEVER_NS : deadline_after({timeout->tv_sec, timeout->tv_usec * 1000});
  const int result = select_until(*thread, count, sets, deadline_ns, nullptr, "select");
  if (timeout != nullptr) {  // what is left, as Linux tells it
    const std::int64_t left = std::max<std::int64_t>(deadline_ns - now_ns(), 0) / 1000;
    *timeout = {left / 1'000'000, left % 1'000'000};
  }
  return result;
}

RSLTRACE_EXPORT int pselect(int count, fd_set *in, fd_set *out, fd_set *odd, const timespec *timeout,
                            const sigset_t *mask) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pselect)(count, in, out, odd, timeout, mask);
  fd_set *sets[3] = {in, out, odd};
  return select_until(*thread, count, sets, timeout == nullptr ? NEVER_NS : deadline_after(*timeout), mask, "pselect");
}

RSLTRACE_EXPORT int epoll_wait(int epoll, epoll_event *events, int count, int timeout) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(epoll_wait)(epoll, events, count, timeout);
  return epoll_until(*thread, epoll, events, count, deadline_in(timeout), nullptr, "epoll_wait");
}

RSLTRACE_EXPORT int epoll_pwait(int epoll, epoll_event *events, int count, int timeout, const sigset_t *mask) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(epoll_pwait)(epoll, events, count, timeout, mask);
  return epoll_until(*thread, epoll, events, count, deadline_in(timeout), mask, "epoll_pwait");
}

RSLTRACE_EXPORT ssize_t read(int fd, void *out, size_t length) {
  return readable(fd, "read") ? REAL(read)(fd, out, length) : -1;
}

RSLTRACE_EXPORT ssize_t readv(int fd, const iovec *parts, int count) {
  return readable(fd, "readv") ? REAL(readv)(fd, parts, count) : -1;
}

RSLTRACE_EXPORT ssize_t recv(int fd, void *out, size_t length, int flags) {
  return readable(fd, "recv", flags) ? REAL(recv)(fd, out, length, flags) : -1;
}

RSLTRACE_EXPORT ssize_t recvfrom(int fd, void *out, size_t length, int flags, sockaddr *from, socklen_t *size) {
  return readable(fd, "recvfrom", flags) ? REAL(recvfrom)(fd, out, length, flags, from, size) : -1;
}

RSLTRACE_EXPORT ssize_t recvmsg(int fd, msghdr *message, int flags) {
  return readable(fd, "recvmsg", flags) ? REAL(recvmsg)(fd, message, flags) : -1;
}

RSLTRACE_EXPORT int accept(int fd, sockaddr *from, socklen_t *size) {
  return readable(fd, "accept") ? REAL(accept)(fd, from, size) : -1;
}

RSLTRACE_EXPORT int accept4(int fd, sockaddr *from, socklen_t *size, int flags) {
  return readable(fd, "accept4") ? REAL(accept4)(fd, from, size, flags) : -1;
}

namespace {

int wait_for_signal(Thread &thread, const sigset_t *set, siginfo_t *information, std::int64_t deadline_ns,
                    const char *what) {
  const int fd = signalfd(-1, set, SFD_NONBLOCK | SFD_CLOEXEC);
  if (fd < 0) return -1;
  Files files{{{fd, POLLIN, 0}}, false, true};
  int result;
  for (;;) {
    timespec none{0, 0};
    result = REAL(sigtimedwait)(set, information, &none);
    if (result > 0 || errno != EAGAIN || deadline_ns <= now_ns()) break;
    wait_for_files(thread, files, deadline_ns, what);
  }
  const int error = errno;
  close(fd);
  errno = error;
  return result;
}

}  // namespace

RSLTRACE_EXPORT int sigtimedwait(const sigset_t *set, siginfo_t *information, const timespec *timeout) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sigtimedwait)(set, information, timeout);
  return wait_for_signal(*thread, set, information, timeout == nullptr ? NEVER_NS : deadline_after(*timeout),
                         "sigtimedwait");
}

RSLTRACE_EXPORT int sigwaitinfo(const sigset_t *set, siginfo_t *information) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sigwaitinfo)(set, information);
  return wait_for_signal(*thread, set, information, NEVER_NS, "sigwaitinfo");
}

RSLTRACE_EXPORT int sigwait(const sigset_t *set, int *signal) {
  Thread *thread = me();
  if (thread == nullptr) return REAL(sigwait)(set, signal);
  *signal = wait_for_signal(*thread, set, nullptr, NEVER_NS, "sigwait");
  return *signal > 0 ? 0 : errno;
}

RSLTRACE_EXPORT int pause() {
  Thread *thread = me();
  if (thread == nullptr) return REAL(pause)();
  {
    Inside inside(*thread);
    wait_at(*thread, Kind::SIGNAL, nullptr, NEVER_NS, "pause", true);
  }
  pthread_testcancel();
  return errno = EINTR, -1;
}

RSLTRACE_EXPORT int sigsuspend(const sigset_t *mask) {
  if (me() == nullptr) return REAL(sigsuspend)(mask);
  const Masked masked(mask);
  return pause();
}
