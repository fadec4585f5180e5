// timerfd on simulated time: an eventfd, to which the expirations are added when their time has come.
#include <sys/eventfd.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include <map>

#include "files.h"
#include "real.h"

namespace rsltrace {
namespace {

struct TimerFile {
  std::int64_t deadline_ns = NEVER_NS;
  std::int64_t interval_ns = 0;
};

std::map<int, TimerFile> &timer_files() {
  static auto *map = new std::map<int, TimerFile>;
  return *map;
}

std::int64_t length_of(const timespec &span) { return span.tv_sec * 1'000'000'000 + span.tv_nsec; }

timespec to_timespec(std::int64_t ns) {
  return {static_cast<time_t>(ns / 1'000'000'000), static_cast<long>(ns % 1'000'000'000)};
}

itimerspec setting(const TimerFile &timer) {
  const bool armed = timer.deadline_ns != NEVER_NS;
  return {to_timespec(timer.interval_ns), to_timespec(armed ? timer.deadline_ns - now_ns() : 0)};
}

}  // namespace

void fire_timer_files() {
  const std::int64_t now = now_ns();
  for (auto &[fd, timer] : timer_files()) {
    if (timer.deadline_ns > now) continue;
    std::uint64_t count = 1;
    if (timer.interval_ns > 0) {
      count += static_cast<std::uint64_t>((now - timer.deadline_ns) / timer.interval_ns);
      timer.deadline_ns += static_cast<std::int64_t>(count) * timer.interval_ns;
    } else {
      timer.deadline_ns = NEVER_NS;
    }
    if (REAL(write)(fd, &count, sizeof count) < 0) timer.deadline_ns = NEVER_NS;  // closed behind our back
  }
}

std::int64_t next_timer_file() {
  std::int64_t next = NEVER_NS;
  for (const auto &[fd, timer] : timer_files()) next = std::min(next, timer.deadline_ns);
  return next;
}

}  // namespace rsltrace

using namespace rsltrace;

RSLTRACE_EXPORT int timerfd_create(clockid_t clock, int flags) noexcept {
  Thread *thread = me();
  if (thread == nullptr) return REAL(timerfd_create)(clock, flags);
  static_assert(int{TFD_NONBLOCK} == int{EFD_NONBLOCK} && int{TFD_CLOEXEC} == int{EFD_CLOEXEC});
  Inside inside(*thread);
  const int fd = eventfd(0, flags);
  if (fd >= 0) timer_files()[fd] = TimerFile{};
  return fd;
}

RSLTRACE_EXPORT int timerfd_settime(int fd, int flags, const itimerspec *asked, itimerspec *before) noexcept {
  Thread *thread = me();
  const auto found = timer_files().find(fd);
  if (thread == nullptr || found == timer_files().end()) return REAL(timerfd_settime)(fd, flags, asked, before);
  if (!valid(&asked->it_value) || !valid(&asked->it_interval)) return errno = EINVAL, -1;
  fire_timer_files();
  TimerFile &timer = found->second;
  if (before != nullptr) *before = setting(timer);
  std::uint64_t count;
  pollfd one{fd, POLLIN, 0};
  if (REAL(poll)(&one, 1, 0) > 0 && REAL(read)(fd, &count, sizeof count) < 0) return -1;
  timer.interval_ns = length_of(asked->it_interval);
  if (length_of(asked->it_value) == 0)
    timer.deadline_ns = NEVER_NS;
  else
    timer.deadline_ns =
        (flags & TFD_TIMER_ABSTIME) != 0 ? deadline_of(asked->it_value) : deadline_after(asked->it_value);
  return 0;
}

RSLTRACE_EXPORT int timerfd_gettime(int fd, itimerspec *out) noexcept {
  const auto found = timer_files().find(fd);
  if (me() == nullptr || found == timer_files().end()) return REAL(timerfd_gettime)(fd, out);
  fire_timer_files();
  *out = setting(found->second);
  return 0;
}

RSLTRACE_EXPORT int close(int fd) {
  if (Thread *thread = timer_files().empty() ? nullptr : me()) {
    Inside inside(*thread);
    timer_files().erase(fd);
  }
  return REAL(close)(fd);
}
