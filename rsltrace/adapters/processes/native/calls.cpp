// Calls that a thread sleeps in, as /proc has them.
#include "calls.h"

#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <iterator>

namespace rsltrace {
namespace {

struct Call {
  long number;
  const char *name;
  bool descriptor;  // its first argument is one
};
constexpr Call CALLS[] = {
    {SYS_read, "read", true},          {SYS_readv, "readv", true},     {SYS_write, "write", true},
    {SYS_writev, "writev", true},      {SYS_ioctl, "ioctl", true},     {SYS_recvfrom, "recv", true},
    {SYS_recvmsg, "recvmsg", true},    {SYS_sendto, "send", true},     {SYS_sendmsg, "sendmsg", true},
    {SYS_accept, "accept", true},      {SYS_accept4, "accept", true},  {SYS_connect, "connect", true},
    {SYS_flock, "flock", true},        {SYS_fcntl, "fcntl", true},     {SYS_openat, "open", false},
    {SYS_futex, "a lock of libc", false}, {SYS_wait4, "wait", false},  {SYS_msgrcv, "msgrcv", false},
    {SYS_rt_sigsuspend, "sigsuspend", false}, {SYS_rt_sigtimedwait, "sigwait", false},
};

std::string target_of(long descriptor) {
  char path[256] = "";
  const std::string link = "/proc/self/fd/" + std::to_string(descriptor);
  if (readlink(link.c_str(), path, sizeof path - 1) < 0) return "descriptor " + std::to_string(descriptor);
  return "descriptor " + std::to_string(descriptor) + ", " + path;
}

}  // namespace

std::string name_of_call(const char *line) {
  char *rest = nullptr;
  const long number = std::strtol(line, &rest, 10);
  for (const Call &call : CALLS)
    if (call.number == number)
      return std::string(call.name) + (call.descriptor ? " (" + target_of(std::strtol(rest, nullptr, 16)) + ")" : "");
  return "system call " + std::to_string(number);
}

namespace {

struct Stream {
  dev_t device;
  ino_t node;
};
Stream printed_to[2];  // where stdout and stderr went when the process started

Stream stream_of(int descriptor) {
  struct stat found {};
  if (fstat(descriptor, &found) != 0) return {};
  return {found.st_dev, found.st_ino};
}

bool is_printed_to(int descriptor) {
  const Stream where = stream_of(descriptor);
  return std::any_of(std::begin(printed_to), std::end(printed_to), [&](const Stream &one) {
    return one.node != 0 && one.node == where.node && one.device == where.device;
  });
}

}  // namespace

void remember_streams() {
  for (int i = 0; i < 2; ++i) printed_to[i] = stream_of(STDOUT_FILENO + i);
}

bool prints(const char *line) {
  char *rest = nullptr;
  const long number = std::strtol(line, &rest, 10);
  return (number == SYS_write || number == SYS_writev) &&
         is_printed_to(static_cast<int>(std::strtoul(rest, nullptr, 16)));
}

}  // namespace rsltrace
