// One thread at a time. Threads hand a baton on where they block, first come first served.
//
// A thread that blocks joins `waiting` in the order of arrival, under the address of what it waits
// for. Who wakes it moves it to `ready`, a queue. If nobody is ready, the process idles: the loop
// says whose deadline, timer or message is next. Only who has the baton touches any of this, so
// there are no locks; threads that come from outside raise a flag and ring the bell.
#pragma once

#include <pthread.h>
#include <sys/types.h>

#include <atomic>
#include <cerrno>
#include <cstdint>
#include <string>
#include <vector>

#include "link.h"

namespace rsltrace {

enum class Kind : std::uint8_t {
  NOTHING, MUTEX, CONDITION, READ, WRITE, ONCE, BARRIER, SEMAPHORE, FUTEX, JOIN, SLEEP, FILES, SIGNAL, ROS
};
enum class State : std::uint8_t { RUNNING, READY, WAITING, OUTSIDE, ENDED };
enum class Outcome : std::uint8_t { WOKEN, TIMEOUT, INTERRUPTED };

constexpr int FRAMES_MAX = 48;

struct Files;  // descriptors that a thread polls (files.h)

struct Thread {
  std::atomic<std::uint32_t> gate{0};  // a futex: an order of who has the baton
  std::atomic<bool> open{false};       // runs the program's code: libc's functions may come to us
  std::atomic<std::uint8_t> seized{0};  // see outside.cpp
  std::atomic<bool> back{false};        // came from outside and wants the baton
  std::atomic<bool> interrupted{false};  // handled a signal while it waited
  State state = State::READY;
  Kind kind = Kind::NOTHING;
  Outcome outcome = Outcome::WOKEN;
  bool granted = false;  // what it waits for is kept for it until it runs
  bool interruptible = false;
  bool service = false;  // ours: never runs the program's code
  bool detached = false;
  bool joining = false;  // somebody joins it
  std::uint32_t number = 0;
  pid_t tid = 0;
  pthread_t handle{};
  const void *address = nullptr;
  const char *what = "";  // the function it waits in, or what it does outside
  std::uint64_t value = 0;  // of the kind: a futex's bits
  Files *files = nullptr;
  Waiter own{};               // for waits of our own
  Waiter *waiter = nullptr;   // what the loop gets to know of this wait
  void *(*routine)(void *) = nullptr;
  void *argument = nullptr;
  int rounds = 0;  // of the thread's destructors
  int signal = 0;  // an order's
  Thread *newcomer = nullptr;  // next in a list
  void *frames[FRAMES_MAX] = {};
  int depth = 0;
};

extern __thread Thread *self __attribute__((tls_model("initial-exec")));
Thread *enter();

// The calling thread if it has the baton and runs the program's code. Null: do as libc does
// (no loop, a forked copy, a signal handler that interrupted the scheduler).
inline Thread *me() {
  Thread *thread = self;
  if (__builtin_expect(thread != nullptr && thread->open.load(std::memory_order_relaxed), 1))
    return thread;
  return enter();
}

// While one of these exists, errno stays as it is and signal handlers of this thread leave the scheduler alone.
class Inside {
 public:
  explicit Inside(Thread &thread) : thread_(thread), errno_(errno) {
    thread_.open.store(false, std::memory_order_relaxed);
  }
  ~Inside() {
    thread_.open.store(true, std::memory_order_relaxed);
    errno = errno_;
  }
  Inside(const Inside &) = delete;
  Inside &operator=(const Inside &) = delete;

 private:
  Thread &thread_;
  int errno_;
};

// All of the following: by who has the baton, inside.

// Wait under `address` until woken, or until the deadline (simulated time).
Outcome wait_at(Thread &thread, Kind kind, const void *address, std::int64_t deadline_ns, const char *what,
                bool interruptible = false);
// As wait_at, in two steps: what is done in between (unlocking a mutex) comes after the arrival.
void arrive(Thread &thread, Kind kind, const void *address, std::int64_t deadline_ns, const char *what,
            bool interruptible = false);
Outcome give_way(Thread &thread);
// Make a waiting thread ready. With `keep`, what it waits for stays its own: it calls `took`.
void wake(Thread &thread, Outcome outcome, bool keep = false);
void took(Thread &thread);
// Who has waited longest under the address (those with a grant are passed over); null if nobody.
Thread *first(const void *address, Kind kind);
// Whether a thread waits under the address, or has a grant of it.
bool anyone(const void *address, Kind kind);
const std::vector<Thread *> &waiting();
extern std::uint32_t locks_waited_for;  // threads that wait for mutexes, or were granted one

void add(Thread &thread);  // a new thread, ready to run
Thread *find(pthread_t handle);
Thread *owner(pid_t tid);
const std::vector<Thread *> &all();
// The thread blocks where the scheduler does not see it, and is back.
void leave(Thread &thread, const char *what);
void come_back(Thread &thread);
// The thread ends, and then its record is deleted if nobody will join it.
void end(Thread &thread);
void forget(Thread &thread);
// Have a thread that stands still do something; returns when it is done. False: it does not stand.
enum class Order : std::uint32_t { NONE = 0, GO = 1, TELL = 2, RAISE = 3, KILL = 4 };
bool order(Thread &thread, Order what, int signal = 0);

// While one of these exists, the thread is in a call that blocks outside; errno is that call's.
class Outside {
 public:
  Outside(Thread &thread, const char *what);
  ~Outside();
  Outside(const Outside &) = delete;
  Outside &operator=(const Outside &) = delete;

 private:
  Thread &thread_;
};

// By who has the baton, not inside.

// Let those that are ready run first.
void yield(Thread &thread);
// A look that did not wait. Too many of them at one instant, and a millisecond passes.
void look(Thread &thread, unsigned weight);
// Of a question to the loop: after a hundred of these a millisecond passes.
constexpr unsigned LOOK_WEIGHT = 100;

long do_futex(Thread &thread, const long *arguments);  // futex.cpp: by who has the baton, not inside

// From anywhere, signal handlers included: have the process look at its flags, files, semaphores.
void ring(bool semaphores = false);

// For the service thread (outside.cpp).
extern Thread service;
void stand(Thread &thread);             // until it is its turn
void turn_over(Thread &thread);         // choose who is next, and hand on
Thread *holder();                       // null while the process idles
std::uint64_t turns();                  // how often the baton was handed on
void seize(Thread &thread, const char *what);  // the holder is outside: the service has the baton

void tell_outside(Thread &thread, const std::string &what);  // once for each `what`

// Other files of ours that the scheduler asks.
bool poll_files();                                   // files.cpp: some thread's files are ready now
void watch_files(bool on);                           // files.cpp: in the bell, while the process idles
bool files_outside();                                // files.cpp: some thread waits for the outside
bool files_wait_for_signals();                       // files.cpp
void post_semaphores();                              // pthread_waits.cpp
void unlocked(const pthread_mutex_t *mutex);         // pthread_locks.cpp: keep it for who waits
void start_service();                                // outside.cpp
void prepare_threads(Thread &main);                  // pthread_lives.cpp
void lock_cycle(Thread &thread);                     // stacks.cpp
void note_frames(Thread &thread);                    // stacks.cpp

std::int64_t deadline_of(const struct timespec &when);
std::int64_t deadline_after(const struct timespec &span);
bool valid(const struct timespec *when);

}  // namespace rsltrace
