#include "scheduler.h"

#include <linux/futex.h>
#include <malloc.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <deque>

#include "entropy.h"
#include "real.h"
#include "threads.h"

namespace rsltrace {

__thread Thread *self __attribute__((tls_model("initial-exec")));
__constinit Thread service;
std::uint32_t locks_waited_for;

namespace {

// What many looks at one instant cost, before time passes.
constexpr unsigned LOOKS_MAX = 10'000;
constexpr std::int64_t LOOK_NS = 1'000'000;
constexpr int HEAPS_MAX = 32;

struct Table {
  std::vector<Thread *> threads;  // in the order of creation
  std::vector<Thread *> waiting;  // in the order of arrival
  std::deque<Thread *> ready;
  std::vector<Waiter *> waiters;  // of an idle()
  std::uint32_t created = 0;
  int outside = 0;
  int eventfd = -1;
  int bell = -1;
  bool stuck = false;  // the deadlock has been reported
};

__constinit Thread main_thread;
Table *table;  // never freed: threads outlive static destructors
std::atomic<Thread *> holding{nullptr};
std::atomic<std::uint64_t> turns_done{0};
std::atomic<bool> idle_now{false};
std::atomic<bool> rung{false};
std::atomic<bool> posted{false};
std::atomic<Thread *> newcomers{nullptr};
std::atomic<std::uint32_t> done{0};  // a futex: the last order was carried out

struct Ended {
  pid_t tid = 0;
  Thread *record = nullptr;
} ended;

long futex(std::atomic<std::uint32_t> &word, int operation, std::uint32_t value) {
  return REAL(syscall)(SYS_futex, &word, operation | FUTEX_PRIVATE_FLAG, value, nullptr, nullptr, 0);
}

// How many heaps threads share depends on the number of processors, and what they get from them
// with it: as many as the four have that a process sees.
void fix_heaps() {
  const char *tuned = std::getenv("GLIBC_TUNABLES");
  const bool is_set = tuned != nullptr && std::strstr(tuned, "arena_max") != nullptr;
  if (!is_set && std::getenv("MALLOC_ARENA_MAX") == nullptr) mallopt(M_ARENA_MAX, HEAPS_MAX);
}

void set_up() {
  fix_heaps();
  table = new Table;
  table->eventfd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
  table->bell = epoll_create1(EPOLL_CLOEXEC);
  epoll_event event{};
  event.events = EPOLLIN;
  REAL(epoll_ctl)(table->bell, EPOLL_CTL_ADD, table->eventfd, &event);
}

void make_ready(Thread &thread) {
  thread.state = State::READY;
  table->ready.push_back(&thread);
}

// Until the thread that ended has left libc's code too: what it gives back (stack, arena) is then
// there for the next in every run. Before that, nothing may ask for memory.
void wait_until_gone() {
  if (ended.tid == 0) return;
  const pid_t pid = REAL(getpid)();
  for (int tries = 0; ended.tid != pid && REAL(syscall)(SYS_tgkill, pid, ended.tid, 0) == 0; ++tries) {
    timespec pause{0, 20'000};
    if (tries < 50)
      REAL(syscall)(SYS_sched_yield);
    else
      REAL(syscall)(SYS_nanosleep, &pause, nullptr);
  }
  ended.tid = 0;
  delete ended.record;
  ended.record = nullptr;
}

void carry_out(Thread &thread, Order what) {
  switch (what) {
    case Order::TELL: note_frames(thread); break;
    case Order::RAISE: REAL(pthread_kill)(pthread_self(), thread.signal); break;
    case Order::KILL: REAL(kill)(REAL(getpid)(), thread.signal); break;
    case Order::NONE:
    case Order::GO: break;
  }
  thread.gate.store(0);
  done.store(1);
  futex(done, FUTEX_WAKE, 1);
}

void hand(Thread &next) {
  holding.store(next.service ? nullptr : &next);
  turns_done.fetch_add(1, std::memory_order_relaxed);
  next.gate.store(static_cast<std::uint32_t>(Order::GO), std::memory_order_release);
  futex(next.gate, FUTEX_WAKE, 1);
}

Thread *pop_ready() {
  Thread *next = table->ready.front();
  table->ready.pop_front();
  return next;
}

// Take in what happened outside of the baton.
void drain() {
  if (!rung.exchange(false)) return;
  std::uint64_t count;
  if (REAL(read)(table->eventfd, &count, sizeof count) < 0) count = 0;
  std::vector<Thread *> came;
  for (Thread *next = newcomers.exchange(nullptr); next != nullptr; next = next->newcomer)
    came.push_back(next);
  for (auto next = came.rbegin(); next != came.rend(); ++next) {
    (*next)->number = ++table->created;
    table->threads.push_back(*next);
    ++table->outside;
  }
  for (Thread *thread : table->threads) {
    if (thread->back.exchange(false)) {
      --table->outside;
      make_ready(*thread);
    }
    if (thread->interrupted.exchange(false) && thread->state == State::WAITING && thread->interruptible)
      wake(*thread, Outcome::INTERRUPTED);
  }
  if (posted.exchange(false)) post_semaphores();
}

void idle_once() {
  table->waiters.clear();
  bool signals = files_wait_for_signals();
  for (Thread *thread : table->waiting) {
    Waiter *waiter = thread->waiter;
    if (waiter != nullptr && (waiter->deadline_ns != NEVER_NS || waiter->set != nullptr))
      table->waiters.push_back(waiter);
    signals |= thread->kind == Kind::SIGNAL || thread->kind == Kind::ROS;
  }
  const bool outside = table->outside > 0 || files_outside();
  if (table->waiters.empty() && !outside && !signals && !table->stuck) {
    table->stuck = true;
    report("deadlock, unless a signal comes: all threads wait, and none for a time, a message or the outside\n" + describe_threads());
  }
  watch_files(true);
  idle_now.store(true);
  if (!rung.load()) idle(table->waiters.data(), table->waiters.size(), outside);
  idle_now.store(false);
  watch_files(false);
  for (std::size_t i = 0; i < table->waiting.size();) {
    Thread &thread = *table->waiting[i];
    if (thread.state == State::WAITING && thread.waiter != nullptr && thread.waiter->woken)
      wake(thread, thread.waiter->ready.kind == Wake::TIMEOUT ? Outcome::TIMEOUT : Outcome::WOKEN);
    else
      ++i;
  }
}

Thread &choose() {
  for (;;) {
    drain();
    if (!table->ready.empty()) return *pop_ready();
    if (!poll_files()) idle_once();
  }
}

void adopt_main(Thread &thread) {
  if (table == nullptr) set_up();
  thread.tid = REAL(getpid)();
  thread.handle = pthread_self();
  thread.state = State::RUNNING;
  table->threads.push_back(&thread);
  self = &thread;
  holding.store(&thread);
  prepare_threads(thread);
  exchange_start_bytes();
  thread.open.store(true);
}

// A thread that libc made for itself, or that was there before us, wants something.
void adopt_stranger() {
  auto *thread = new Thread;
  self = thread;
  thread->tid = static_cast<pid_t>(REAL(syscall)(SYS_gettid));
  thread->handle = pthread_self();
  thread->detached = true;
  thread->state = State::OUTSIDE;
  thread->back.store(true);
  thread->newcomer = newcomers.load();
  while (!newcomers.compare_exchange_weak(thread->newcomer, thread)) {
  }
  ring();
  stand(*thread);
  thread->state = State::RUNNING;
  thread->open.store(true);
}

}  // namespace

Thread *enter() {
  if (!linked()) return nullptr;
  Thread *thread = self;
  if (thread == nullptr) {
    if (REAL(syscall)(SYS_gettid) == REAL(getpid)())
      adopt_main(main_thread);
    else if (table != nullptr)
      adopt_stranger();
    return self;
  }
  std::uint8_t seizing = 1;
  if (thread->service || thread->seized.load() == 0) return nullptr;
  if (thread->seized.compare_exchange_strong(seizing, 0)) {
    thread->open.store(true);
    return thread;
  }
  thread->seized.store(0);
  come_back(*thread);
  thread->open.store(true);
  return thread;
}

void arrive(Thread &thread, Kind kind, const void *address, std::int64_t deadline_ns, const char *what,
            bool interruptible) {
  thread.state = State::WAITING;
  thread.kind = kind;
  thread.address = address;
  thread.what = what;
  thread.interruptible = interruptible;
  thread.granted = false;
  if (kind != Kind::ROS) {
    thread.own = Waiter{};
    thread.own.thread = thread.number;
    thread.own.deadline_ns = deadline_ns;
    thread.own.what = what;
    thread.waiter = &thread.own;
  }
  table->waiting.push_back(&thread);
  if (kind == Kind::MUTEX) ++locks_waited_for;
}

Outcome give_way(Thread &thread) {
  Thread &next = choose();
  if (&next != &thread) {
    hand(next);
    stand(thread);
  }
  thread.state = State::RUNNING;
  return thread.outcome;
}

Outcome wait_at(Thread &thread, Kind kind, const void *address, std::int64_t deadline_ns, const char *what,
                bool interruptible) {
  arrive(thread, kind, address, deadline_ns, what, interruptible);
  return give_way(thread);
}

void wake(Thread &thread, Outcome outcome, bool keep) {
  thread.outcome = outcome;
  thread.waiter = nullptr;
  thread.granted = keep;
  if (!keep) took(thread);
  table->stuck = false;
  make_ready(thread);
}

void took(Thread &thread) {
  auto &list = table->waiting;
  list.erase(std::find(list.begin(), list.end(), &thread));
  thread.granted = false;
  if (thread.kind == Kind::MUTEX) --locks_waited_for;
}

Thread *first(const void *address, Kind kind) {
  for (Thread *thread : table->waiting)
    if (thread->address == address && thread->kind == kind && !thread->granted) return thread;
  return nullptr;
}

bool anyone(const void *address, Kind kind) {
  for (Thread *thread : table->waiting)
    if (thread->address == address && thread->kind == kind) return true;
  return false;
}

const std::vector<Thread *> &waiting() { return table->waiting; }
const std::vector<Thread *> &all() { return table->threads; }

void add(Thread &thread) {
  thread.number = ++table->created;
  table->threads.push_back(&thread);
  make_ready(thread);
}

Thread *find(pthread_t handle) {
  for (Thread *thread : table->threads)
    if (pthread_equal(thread->handle, handle)) return thread;
  return nullptr;
}

Thread *owner(pid_t tid) {
  for (Thread *thread : table->threads)
    if (thread->tid == tid && thread->state != State::ENDED) return thread;
  return nullptr;
}

void leave(Thread &thread, const char *what) {
  thread.state = State::OUTSIDE;
  thread.what = what;
  ++table->outside;
  drain();
  hand(table->ready.empty() ? service : *pop_ready());
}

void come_back(Thread &thread) {
  thread.back.store(true);
  ring();
  stand(thread);
  thread.state = State::RUNNING;
}

void end(Thread &thread) {
  thread.state = State::ENDED;
  if (std::all_of(table->threads.begin(), table->threads.end(),
                  [](Thread *one) { return one->state == State::ENDED; }))
    exit(0);  // as libc does when the last thread has ended
  while (Thread *joiner = first(&thread, Kind::JOIN)) wake(*joiner, Outcome::WOKEN);
  ended.tid = static_cast<pid_t>(REAL(syscall)(SYS_gettid));
  if (thread.detached) {
    forget(thread);
    ended.record = &thread;
  }
  drain();
  hand(table->ready.empty() ? service : *pop_ready());
}

void forget(Thread &thread) {
  auto &list = table->threads;
  list.erase(std::find(list.begin(), list.end(), &thread));
}

bool order(Thread &thread, Order what, int signal) {
  if (&thread == self) {
    if (what == Order::TELL) note_frames(thread);
    return what == Order::TELL;
  }
  if (thread.state != State::WAITING && thread.state != State::READY) return false;
  thread.signal = signal;
  done.store(0);
  thread.gate.store(static_cast<std::uint32_t>(what));
  futex(thread.gate, FUTEX_WAKE, 1);
  while (done.load() == 0) futex(done, FUTEX_WAIT, 0);
  if (what != Order::TELL && thread.state == State::WAITING && thread.interruptible)
    wake(thread, Outcome::INTERRUPTED);
  return true;
}

void yield(Thread &thread) {
  if (table->ready.empty()) return look(thread, LOOKS_MAX / 100);
  look(thread, 1);
  Inside inside(thread);
  drain();
  make_ready(thread);
  hand(*pop_ready());
  stand(thread);
  thread.state = State::RUNNING;
}

void look(Thread &thread, unsigned weight) {
  static std::uint64_t since;
  static unsigned looks;
  if (times_let_go() != since) looks = 0;  // it has waited: many callbacks at one instant are no loop
  since = times_let_go();
  looks += weight;
  if (looks < LOOKS_MAX) return;
  looks = 0;
  Inside inside(thread);
  wait_at(thread, Kind::SLEEP, nullptr, now_ns() + LOOK_NS, "a loop that looks and does not wait");
}

void ring(bool semaphores) {
  if (semaphores) posted.store(true);
  rung.store(true);
  const std::uint64_t one = 1;
  if (idle_now.load() && REAL(write)(table->eventfd, &one, sizeof one) < 0) return;
}

void stand(Thread &thread) {
  for (;;) {
    const auto what = static_cast<Order>(thread.gate.load(std::memory_order_acquire));
    if (what == Order::GO) {
      thread.gate.store(0);
      return wait_until_gone();
    }
    if (what != Order::NONE) {
      carry_out(thread, what);
    } else if (futex(thread.gate, FUTEX_WAIT, 0) < 0 && errno == EINTR) {
      thread.interrupted.store(true);
      ring();
    }
  }
}

void turn_over(Thread &) { hand(choose()); }

Thread *holder() { return idle_now.load() ? nullptr : holding.load(); }
std::uint64_t turns() { return turns_done.load(); }

void seize(Thread &thread, const char *what) {
  thread.state = State::OUTSIDE;
  thread.what = what;
  ++table->outside;
  holding.store(nullptr);
}

void park(Waiter &waiter) {
  Thread *thread = me();
  if (thread == nullptr) return;
  Inside inside(*thread);
  waiter.thread = thread->number;
  thread->waiter = &waiter;
  wait_at(*thread, Kind::ROS, &waiter, waiter.deadline_ns, waiter.what);
}

void wake(Waiter &waiter) {
  waiter.woken = true;
  Thread *thread = first(&waiter, Kind::ROS);
  if (thread == nullptr) return;
  const bool open = self != nullptr && self->open.exchange(false);
  wake(*thread, Outcome::WOKEN);
  if (open) self->open.store(true);
}

std::uint32_t this_thread() { return self == nullptr ? 0 : self->number; }
int bell_fd() { return table->bell; }

void raise_in_main(int signal) {
  if (self == &main_thread)
    REAL(kill)(REAL(getpid)(), signal);
  else if (!order(main_thread, Order::KILL, signal))
    REAL(kill)(REAL(getpid)(), signal);
  ring();
}

}  // namespace rsltrace
