#include "link.h"

#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <string_view>

#include "call_sites.h"
#include "endpoints.h"
#include "entropy.h"
#include "guard_conditions.h"
#include "shared.h"
#include "threads.h"
#include "turns.h"

namespace rsltrace {

namespace {

constexpr int FAR = 1000;  // below what select() can take, and most limits

int turn_fd = -1;  // a pipe: a byte for each time that the loop has spoken
int said_fd = -1;  // an eventfd: rung for each batch
std::int64_t time_ns = 0;
std::uint64_t seed_of_process = 0;
bool own_clocks = false;
bool sleeps_are_instant = false;
bool keeps_intra_process = false;
std::uint64_t lets_go = 0;
std::uint32_t ready_id = 0;

// What the process has said and the loop has not taken: its length, then whole records. The loop
// sets the length to zero, and finds here what a process has said that was killed.
__constinit Shared said;
// What the loop has said last.
__constinit Shared told;

Turns &turns() { return *reinterpret_cast<Turns *>(said.data); }

std::atomic<std::uint64_t> &length_said() { return turns().length; }

constexpr std::size_t LENGTH = sizeof(Turns);

[[noreturn]] void leave(int status) {
  syscall(SYS_exit_group, status);
  __builtin_unreachable();
}

// The loop is gone, or says nothing that makes sense: nothing of this process may outlive the run.
[[noreturn]] void lost() { leave(120); }

// Whether the program has closed a descriptor of the link. It is asked for each batch, as whether the
// descriptors are needed depends on who sleeps.
bool is_closed() {
  pollfd both[] = {{turn_fd, 0, 0}, {said_fd, 0, 0}};
  constexpr timespec now{};
  if (syscall(SYS_ppoll, both, 2, &now, nullptr, 0) <= 0) return false;
  return ((both[0].revents | both[1].revents) & POLLNVAL) != 0;
}

void send_batch() {
  if (is_closed()) lost();
  turns().batches.fetch_add(1);
  if (turns().loop_sleeps.exchange(0) == 0 && turns().may_spin != 0) return;
  constexpr std::uint64_t once = 1;
  while (syscall(SYS_write, said_fd, &once, sizeof once) < 0) {
    if (errno != EINTR) lost();
  }
}

struct Message {
  Told kind;
  const std::uint8_t *body;
  std::size_t size;
};

// Return the next thing that the loop says; it stays readable until the next call.
Message listen() {
  if (!has_turn(turns())) {
    char byte;
    long got;
    do {
      got = syscall(SYS_read, turn_fd, &byte, 1);
    } while (got < 0 && errno == EINTR);
    if (got != 1) lost();
  }
  std::uint32_t head[2];
  std::memcpy(head, told.data, sizeof head);
  if (sizeof head + head[0] > told.size && !told.look_again()) lost();
  const auto kind = static_cast<Told>(head[1]);
  if (kind == Told::KILL) {
    fflush(nullptr);
    leave(0);
  }
  return {kind, told.data + sizeof head, head[0]};
}

void forked() {
  if (turn_fd >= 0) {
    syscall(SYS_close, turn_fd);
    syscall(SYS_close, said_fd);
  }
  turn_fd = said_fd = -1;
  said.forget();
  told.forget();
}

// What this process starts itself is no part of the run. In place: what the heap was asked for here
// would depend on where the library lies, and so would the addresses of all that follows.
void forget_environment() {
  unsetenv("RSLTRACE_LINK");
  char *const preload = getenv("LD_PRELOAD");
  if (preload == nullptr) return;
  char *kept = preload;
  for (const char *rest = preload; *rest != '\0';) {
    const std::string_view name(rest, strcspn(rest, ":"));
    rest += name.size() + (rest[name.size()] == ':');
    const auto file = name.substr(name.rfind('/') + 1);
    if (file.rfind("librmw_rsltrace", 0) == 0 || file.rfind("librsltrace_", 0) == 0) continue;
    if (kept != preload) *kept++ = ':';
    memmove(kept, name.data(), name.size());
    kept += name.size();
  }
  *kept = '\0';
  if (kept == preload) unsetenv("LD_PRELOAD");
}

// Out of the way: the numbers that the program's own descriptors get must not depend on those that
// rsltrace had free.
int far(int fd) {
  const int there = fcntl(fd, F_DUPFD_CLOEXEC, FAR);
  if (there < 0) return fd;
  syscall(SYS_close, fd);
  return there;
}

bool has_no_writer(int fd) {
  pollfd end{fd, 0, 0};
  const timespec at_once{};
  return syscall(SYS_ppoll, &end, 1, &at_once, nullptr, 8) == 1 && (end.revents & POLLHUP) != 0;
}

void begin() {
  const char *link = getenv("RSLTRACE_LINK");
  int parent = 0;
  int files[4] = {-1, -1, -1, -1};
  unsigned noise = 0;
  if (link == nullptr || sscanf(link, "%d:%d:%d:%d:%d:%u", &parent, &files[0], &files[1], &files[2], &files[3], &noise) < 5) return;
  if (getppid() != parent) {
    if (has_no_writer(files[0])) lost();  // rsltrace was killed before this process got here
    return;                       // started by a process of the run: outside of it
  }
  if (prctl(PR_SET_PDEATHSIG, SIGKILL) != 0 || getppid() != parent) leave(120);
  prctl(PR_SET_PTRACER, PR_SET_PTRACER_ANY);  // gdb may attach where Yama lets only parents do that
  if (!said.open(far(files[2])) || !told.open(far(files[3]))) leave(120);
  turn_fd = far(files[0]);
  said_fd = far(files[1]);
  signal(SIGINT, SIG_DFL);  // a run in the background of a shell, or under nohup, is no other run
  signal(SIGHUP, SIG_DFL);
  sigset_t none;
  sigemptyset(&none);
  sigprocmask(SIG_SETMASK, &none, nullptr);
  fcntl(turn_fd, F_SETFD, FD_CLOEXEC);  // whatever takes the place of this program cannot be run by it
  fcntl(said_fd, F_SETFD, FD_CLOEXEC);
  forget_environment();
  pthread_atfork(nullptr, nullptr, forked);
  Writer hello;
  hello.number(static_cast<std::uint32_t>(getpid()));
  const auto answer = ask(Say::HELLO, hello);
  Reader reader(answer.data(), answer.size());
  time_ns = reader.number<std::int64_t>();
  seed_of_process = reader.number<std::uint64_t>();
  own_clocks = reader.number<std::uint32_t>() != 0;
  sleeps_are_instant = reader.number<std::uint32_t>() != 0;
  keeps_intra_process = reader.number<std::uint32_t>() != 0;
  if (noise != 0) fragment_heap(noise);
}

}  // namespace

// By the first who asks: constructors of libraries run before ours, and are part of the run.
__attribute__((constructor(101))) bool linked() {
  static bool begun = false;
  if (__builtin_expect(!begun, 0)) {
    begun = true;
    begin();
  }
  return turn_fd >= 0;
}

std::int64_t now_ns() { return time_ns; }

std::uint64_t seed() { return seed_of_process; }

bool has_own_clocks() { return own_clocks; }

bool has_instant_sleep() { return sleeps_are_instant; }

bool has_intra_process() { return keeps_intra_process; }

std::uint64_t times_let_go() { return lets_go; }

std::uint32_t last_ready() { return ready_id; }

void say(Say kind, const void *body, std::size_t size) {
  if (!linked()) return;
  const std::uint32_t head[2] = {static_cast<std::uint32_t>(kind), static_cast<std::uint32_t>(size)};
  const std::size_t start = LENGTH + length_said().load(std::memory_order_relaxed);
  if (start > said.size) lost();  // the program has written over it
  const std::size_t end = start + sizeof head + size;
  if (end > said.size && !said.grow(2 * end)) lost();
  std::memcpy(said.data + start, head, sizeof head);
  if (size > 0) std::memcpy(said.data + start + sizeof head, body, size);
  length_said().store(end - LENGTH, std::memory_order_release);  // not before it is whole
}

void say(Say kind, const Writer &body) { say(kind, body.bytes.data(), body.bytes.size()); }

std::vector<std::uint8_t> ask(Say kind, const Writer &body) {
  const Asking asking;
  say(kind, body);
  send_batch();
  const Message message = listen();
  if (message.kind != Told::ANSWER) lost();
  return std::vector<std::uint8_t>(message.body, message.body + message.size);
}

namespace {

// While a thread is outside, simulated time is let go on in steps of this, and only as fast as real
// time: in between the loop runs whatever else is due.
constexpr std::int64_t PACE_NS = 10'000'000;
constexpr std::uint32_t PACER = UINT32_MAX;  // the number of no thread

std::int64_t real_ns() {
  timespec now{};
  syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1'000'000'000 + now.tv_nsec;
}

// Wait in real time until simulated time may go on by a step; true if the bell has rung instead.
bool pace(bool was_outside) {
  static std::int64_t ahead_ns;  // of simulated time, to what a real clock shows
  if (!was_outside || time_ns - real_ns() < ahead_ns) ahead_ns = time_ns - real_ns();
  const std::int64_t left = std::max<std::int64_t>(time_ns + PACE_NS - ahead_ns - real_ns(), 0);
  const timespec limit{0, static_cast<long>(std::min(left, PACE_NS))};
  pollfd bell{bell_fd(), POLLIN, 0};
  return syscall(SYS_ppoll, &bell, 1, &limit, nullptr, 8) != 0;
}

void say_wait(const std::vector<const Waiter *> &waiters) {
  Writer body;
  body.number(static_cast<std::uint32_t>(waiters.size()));
  for (const Waiter *waiter : waiters) {
    body.number(waiter->thread);
    body.number(waiter->set == nullptr ? 0U : waiter->set->set);
    body.number(waiter->deadline_ns);
    body.text(waiter->what);
  }
  say(Say::WAIT, body);
}

}  // namespace

void idle(Waiter *const *waiters, std::size_t count, bool outside) {
  static bool was_outside = false;
  const bool rung = outside && pace(was_outside);
  was_outside = outside;
  if (rung) return;
  std::vector<const Waiter *> told(waiters, waiters + count);
  Waiter pacer;
  pacer.thread = PACER;
  pacer.deadline_ns = time_ns + PACE_NS;
  pacer.what = "a call that blocks outside";
  if (outside) told.push_back(&pacer);
  note_latest_draws();
  say_wait(told);
  send_batch();
  const Message message = listen();
  if (message.kind == Told::STOP) {
    raise_in_main(SIGINT);  // as whoever starts nodes does; without a handler, the process ends here
    for (std::size_t i = 0; i < count; i++) {
      if (waiters[i]->woken || (waiters[i]->thread != 0 && count > 1)) continue;
      waiters[i]->woken = true;
      waiters[i]->ready = {Wake::STOP, 0};
    }
    return;
  }
  if (message.kind != Told::GO) lost();
  Reader reader(message.body, message.size);
  time_ns = reader.number<std::int64_t>();
  ++lets_go;
  const auto thread = reader.number<std::uint32_t>();
  Ready ready;
  ready.kind = static_cast<Wake>(reader.number<std::uint32_t>());
  ready.id = ready_id = reader.number<std::uint32_t>();
  if (ready.kind == Wake::ENTITY) deliver(ready.id, reader);
  if (ready.kind == Wake::TIMER) timer_may_run(ready.id);
  if (ready.kind == Wake::GRAPH) graph_has_changed();
  for (std::size_t i = 0; i < count; i++) {
    if (waiters[i]->thread == thread) {
      waiters[i]->woken = true;
      waiters[i]->ready = ready;
    }
  }
}

void report(const std::string &text) {
  if (!linked()) return;
  Writer body;
  body.text(text);
  say(Say::REPORT, body);
}

void *original(const char *library, const char *name) {
  void *handle = dlopen(library, RTLD_LAZY | RTLD_NOLOAD);
  void *found = handle == nullptr ? dlsym(RTLD_NEXT, name) : dlsym(handle, name);
  if (found == nullptr) {
    fprintf(stderr, "rsltrace: %s has no %s\n", library, name);
    abort();
  }
  return found;
}

}  // namespace rsltrace
