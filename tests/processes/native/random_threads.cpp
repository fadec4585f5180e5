// A random program of threads: `random_threads SEED`. Each seed is another program; it has no deadlock,
// whatever the order. On stderr: what happened in which order, at which time. On stdout: results that
// do not depend on the order, so that they can be compared with a native run.
#include <pthread.h>
#include <semaphore.h>
#include <sys/eventfd.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include <atomic>
#include <barrier>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <functional>
#include <future>
#include <latch>
#include <mutex>
#include <random>
#include <semaphore>
#include <shared_mutex>
#include <string>
#include <thread>
#include <vector>

using namespace std::chrono_literals;
using Random = std::mt19937_64;

namespace {

const auto start = std::chrono::steady_clock::now();
std::mutex log_mutex;
std::string story;

void note(int thread, const std::string &what) {
  const std::lock_guard lock(log_mutex);
  const auto time = std::chrono::steady_clock::now() - start;
  story += std::to_string(time.count()) + " " + std::to_string(thread) + " " + what + "\n";
}

template <typename T>
int below(Random &random, T bound) {
  return static_cast<int>(random() % static_cast<std::uint64_t>(bound));
}

std::chrono::microseconds span(Random &random) { return std::chrono::microseconds(below(random, 40) * 50); }

class Queue {  // of a thread pool
 public:
  void put(int value) {
    {
      const std::lock_guard lock(mutex_);
      items_.push_back(value);
    }
    changed_.notify_one();
  }
  int take() {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [this] { return !items_.empty(); });
    const int value = items_.front();
    items_.pop_front();
    return value;
  }
  bool take_for(std::chrono::microseconds patience, int &value) {
    std::unique_lock lock(mutex_);
    if (!changed_.wait_for(lock, patience, [this] { return !items_.empty(); })) return false;
    value = items_.front();
    items_.pop_front();
    return true;
  }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<int> items_;
};

constexpr int LOCKS = 4;

struct World {
  std::mutex plain[LOCKS];
  std::timed_mutex timed;
  std::recursive_mutex recursive;
  std::shared_mutex shared;
  pthread_rwlock_t rwlock = PTHREAD_RWLOCK_INITIALIZER;
  pthread_spinlock_t spin;
  std::counting_semaphore<8> places{2};
  sem_t tokens;
  std::once_flag once;
  pthread_once_t c_once = PTHREAD_ONCE_INIT;
  std::atomic<int> flag{0};
  Queue queue;
  int counters[LOCKS] = {};
  int deep = 0, written = 0, spun = 0, onces = 0, inside = 0;
  std::atomic<int> asynchronous{0}, pooled{0}, slept{0};
  World() {
    sem_init(&tokens, 0, 3);
    pthread_spin_init(&spin, PTHREAD_PROCESS_PRIVATE);
  }
};

World *world;
thread_local struct Farewell {
  int thread = -1;
  ~Farewell() {
    if (thread >= 0) note(thread, "thread_local destroyed");
  }
} farewell;

void locks(Random &random, int thread) {
  const int a = below(random, LOCKS), b = below(random, LOCKS);
  if (a == b) {
    const std::lock_guard lock(world->plain[a]);
    if (below(random, 2) == 0) std::this_thread::sleep_for(span(random));
    ++world->counters[a];
  } else {
    const std::scoped_lock lock(world->plain[a], world->plain[b]);
    if (below(random, 3) == 0) std::this_thread::yield();
    ++world->counters[a], ++world->counters[b];
  }
  note(thread, "locks " + std::to_string(a) + std::to_string(b));
}

void timed(Random &random, int thread) {
  const auto patience = span(random), pause = span(random);
  const bool had = world->timed.try_lock_for(patience);
  if (had) {
    std::this_thread::sleep_for(pause);
    world->timed.unlock();
  }
  note(thread, had ? "timed" : "timed out");
}

void recursive(Random &random, int thread) {
  const std::lock_guard first(world->recursive);
  const std::lock_guard second(world->recursive);
  if (below(random, 2) == 0) std::this_thread::sleep_for(span(random));
  ++world->deep;
  note(thread, "recursive");
}

void readers(Random &random, int thread) {
  if (below(random, 3) == 0) {
    const std::unique_lock lock(world->shared);
    std::this_thread::sleep_for(span(random));
    ++world->written;
  } else {
    const std::shared_lock lock(world->shared);
    std::this_thread::sleep_for(span(random));
  }
  if (below(random, 2) == 0) pthread_rwlock_wrlock(&world->rwlock);
  else pthread_rwlock_rdlock(&world->rwlock);
  std::this_thread::yield();
  pthread_rwlock_unlock(&world->rwlock);
  note(thread, "readers");
}

void semaphores(Random &random, int thread) {
  world->places.acquire();
  std::this_thread::sleep_for(span(random));
  world->places.release();
  timespec when;
  clock_gettime(CLOCK_REALTIME, &when);
  when.tv_sec += 1000;
  if (below(random, 2) == 0) sem_wait(&world->tokens);
  else sem_timedwait(&world->tokens, &when);
  std::this_thread::yield();
  sem_post(&world->tokens);
  note(thread, "semaphores");
}

void onces(Random &random, int thread) {
  const auto pause = span(random);
  std::call_once(world->once, [pause] {
    std::this_thread::sleep_for(pause);
    ++world->onces;
  });
  pthread_once(&world->c_once, [] {
    usleep(300);
    ++world->onces;
  });
  note(thread, "once");
}

void spins(Random &, int thread) {
  pthread_spin_lock(&world->spin);
  std::this_thread::yield();
  ++world->spun;
  pthread_spin_unlock(&world->spin);
  note(thread, "spin");
}

void futures(Random &random, int thread) {
  const auto pause = span(random);
  auto answer = std::async(std::launch::async, [pause] {
    std::this_thread::sleep_for(pause);
    return 7;
  });
  const bool early = answer.wait_for(span(random)) == std::future_status::ready;
  world->asynchronous += answer.get();
  note(thread, early ? "future" : "late future");
}

void atomics(Random &random, int thread) {
  std::thread other([pause = span(random)] {
    std::this_thread::sleep_for(pause);
    ++world->flag;
    world->flag.notify_all();
  });
  const int before = world->flag;
  if (below(random, 2) == 0) other.join();
  else {
    world->flag.wait(before);
    other.join();
  }
  note(thread, "atomics");
}

void files(Random &random, int thread) {
  const int timer = timerfd_create(CLOCK_MONOTONIC, 0), event = eventfd(0, 0);
  const itimerspec when{{0, 0}, {0, 1000 * (1 + below(random, 500))}};
  timerfd_settime(timer, 0, &when, nullptr);
  std::thread other([event, pause = span(random)] {
    std::this_thread::sleep_for(pause);
    const std::uint64_t one = 1;
    if (write(event, &one, sizeof one) < 0) std::abort();
  });
  std::uint64_t count;
  if (read(event, &count, sizeof count) < 0 || read(timer, &count, sizeof count) < 0) std::abort();
  other.join();
  close(timer), close(event);
  note(thread, "files " + std::to_string(count));
}

void sleeps(Random &random, int thread) {
  std::this_thread::sleep_for(span(random));
  ++world->slept;
  note(thread, "slept");
}

void pool(Random &random, int) { world->queue.put(1 + below(random, 9)); }

using Step = void (*)(Random &, int);
constexpr Step STEPS[] = {locks, timed, recursive, readers, semaphores, onces, spins, futures, atomics, files, sleeps, pool};

void worker(std::uint64_t seed, int thread, int steps, std::barrier<> &barrier, std::latch &latch) {
  farewell.thread = thread;
  Random random(seed * 1000 + static_cast<std::uint64_t>(thread));
  note(thread, "begins");
  for (int i = 0; i < steps; ++i) STEPS[static_cast<std::size_t>(below(random, std::size(STEPS)))](random, thread);
  barrier.arrive_and_wait();
  locks(random, thread);
  latch.count_down();
}

}  // namespace

int main(int, char **argv) {
  const std::uint64_t seed = std::strtoull(argv[1], nullptr, 10);
  Random random(seed);
  world = new World;
  const int threads = 2 + below(random, 6), steps = 3 + below(random, 12), pool_size = 1 + below(random, 3);
  std::barrier barrier(threads);
  std::latch latch(threads);
  std::vector<std::thread> pool_threads, all;
  for (int i = 0; i < pool_size; ++i)
    pool_threads.emplace_back([i] {
      for (;;) {
        int value = 0;
        if (!world->queue.take_for(300us, value)) value = world->queue.take();
        if (value == 0) return;
        std::this_thread::sleep_for(std::chrono::microseconds(value * 10));
        world->pooled += value;
        note(100 + i, "pool " + std::to_string(value));
      }
    });
  for (int i = 0; i < threads; ++i)
    all.emplace_back(worker, seed, i, steps, std::ref(barrier), std::ref(latch));
  latch.wait();
  for (auto &thread : all) thread.join();
  for (int i = 0; i < pool_size; ++i) world->queue.put(0);
  for (auto &thread : pool_threads) thread.join();
  std::fputs(story.c_str(), stderr);
  for (const int counter : world->counters) std::printf("%d ", counter);
  std::printf("%d %d %d %d %d %d %d\n", world->deep, world->written, world->spun, world->onces,
              world->asynchronous.load(), world->pooled.load(), world->slept.load());
}
