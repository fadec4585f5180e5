// Threads that wait for descriptors. The descriptors stay the kernel's and are only ever polled:
// before the process idles, for what its own threads wrote; and while it idles, for the outside.
#include "files.h"

#include <dirent.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <fstream>

#include "real.h"
#include "threads.h"

namespace rsltrace {
namespace {

std::string target(int descriptor) {
  char path[256] = "";
  return readlink(("/proc/self/fd/" + std::to_string(descriptor)).c_str(), path, sizeof path - 1) < 0 ? "" : path;
}

bool has_other_end(int descriptor, const std::string &pipe) {
  DIR *folder = opendir("/proc/self/fd");
  if (folder == nullptr) return false;
  bool found = false;
  while (const dirent *entry = readdir(folder)) {
    const int other = std::atoi(entry->d_name);
    found |= entry->d_name[0] != '.' && other != descriptor && target(other) == pipe;
  }
  closedir(folder);
  return found;
}

bool is_pair_of_ours(int descriptor) {
  ucred peer{};
  socklen_t length = sizeof peer;
  return getsockopt(descriptor, SOL_SOCKET, SO_PEERCRED, &peer, &length) == 0 && peer.pid == REAL(getpid)();
}

bool any_outside(int epoll, std::string &where) {
  std::ifstream list("/proc/self/fdinfo/" + std::to_string(epoll));
  std::string word;
  while (list >> word) {
    int descriptor;
    if (word == "tfd:" && list >> descriptor && descriptor != epoll && comes_from_outside(descriptor, where))
      return true;
  }
  return false;
}

}  // namespace

bool comes_from_outside(int descriptor, std::string &where) {
  const std::string name = target(descriptor);
  if (name == "anon_inode:[eventpoll]") return any_outside(descriptor, where);
  if (name.empty() || name == "anon_inode:[eventfd]" || name == "anon_inode:[signalfd]") return false;
  if (name.rfind("pipe:", 0) == 0 && has_other_end(descriptor, name)) return false;
  if (name.rfind("socket:", 0) == 0 && is_pair_of_ours(descriptor)) return false;
  where = "descriptor " + std::to_string(descriptor) + ", " + name;
  return true;
}

Outcome wait_for_files(Thread &thread, Files &files, std::int64_t deadline_ns, const char *what) {
  pthread_testcancel();
  Outcome outcome;
  {
    Inside inside(thread);
    std::string where;
    for (const pollfd &one : files.list)
      files.outside = files.outside || (one.fd >= 0 && comes_from_outside(one.fd, where));
    if (files.outside) tell_outside(thread, std::string(what) + " (" + where + ")");
    thread.files = &files;
    const std::int64_t timer_ns = next_timer_file();
    outcome = wait_at(thread, Kind::FILES, &files, deadline_ns < timer_ns ? deadline_ns : timer_ns, what, true);
    thread.files = nullptr;
    if (outcome == Outcome::TIMEOUT && now_ns() < deadline_ns) outcome = Outcome::WOKEN;  // a timerfd's time
  }
  fire_timer_files();
  if (outcome == Outcome::INTERRUPTED) pthread_testcancel();
  return outcome;
}

bool poll_files() {
  bool found = false;
  for (std::size_t i = 0; i < waiting().size();) {
    Thread &thread = *waiting()[i];
    Files *files = thread.kind == Kind::FILES ? thread.files : nullptr;
    if (files != nullptr && REAL(poll)(files->list.data(), files->list.size(), 0) != 0) {
      wake(thread, Outcome::WOKEN);
      found = true;
    } else {
      ++i;
    }
  }
  return found;
}

void watch_files(bool on) {
  for (Thread *thread : waiting()) {
    if (thread->kind != Kind::FILES) continue;
    for (const pollfd &one : thread->files->list) {
      epoll_event event{};
      event.events = static_cast<std::uint32_t>(one.events);
      REAL(epoll_ctl)(bell_fd(), on ? EPOLL_CTL_ADD : EPOLL_CTL_DEL, one.fd, &event);
    }
  }
}

bool files_outside() {
  for (Thread *thread : waiting())
    if (thread->kind == Kind::FILES && thread->files->outside) return true;
  return false;
}

bool files_wait_for_signals() {
  for (Thread *thread : waiting())
    if (thread->kind == Kind::FILES && thread->files->signals) return true;
  return false;
}

}  // namespace rsltrace
