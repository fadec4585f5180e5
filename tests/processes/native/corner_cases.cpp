// One corner of threads, time or chance per run: `corner_cases NAME`. What is printed is the result.
#include <dlfcn.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <semaphore.h>
#include <signal.h>
#include <spawn.h>
#include <sys/epoll.h>
#include <sys/file.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/sysinfo.h>
#include <sys/time.h>
#include <sys/times.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <functional>
#include <map>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

using namespace std::chrono_literals;

namespace {

std::int64_t now_us() {
  static const auto start = std::chrono::steady_clock::now();
  return std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::steady_clock::now() - start).count();
}
const std::int64_t begun = now_us();

void say(const char *what) {
  std::printf("%lld %s\n", static_cast<long long>(now_us() - begun), what);
  std::fflush(stdout);
}

std::mutex one, two;

void itself() {
  one.lock();
  pthread_mutex_lock(one.native_handle());
}

void cycle() {
  std::thread other([] {
    const std::lock_guard second(two);
    std::this_thread::sleep_for(1ms);
    const std::lock_guard first(one);
  });
  const std::lock_guard first(one);
  std::this_thread::sleep_for(1ms);
  const std::lock_guard second(two);
}

void everybody() {
  static std::condition_variable changed;
  std::thread other([] {
    std::unique_lock lock(two);
    changed.wait(lock);
  });
  pthread_setname_np(other.native_handle(), "waiter");
  other.join();
}

sem_t posted;
volatile sig_atomic_t handled = 0;

void on_signal(int) {
  handled = 1;
  sem_post(&posted);
}

void install(int signal) {
  sem_init(&posted, 0, 0);
  struct sigaction action = {};
  action.sa_handler = on_signal;
  sigaction(signal, &action, nullptr);
}

void handler_posts() {  // as rclcpp does it
  install(SIGINT);
  std::thread deferred([] {
    while (sem_wait(&posted) != 0) {
    }
    say("posted");
  });
  std::thread sender([] {
    std::this_thread::sleep_for(5ms);
    kill(getpid(), SIGINT);
    say("sent");
  });
  const timespec second{1, 0};
  timespec left{};
  const int result = nanosleep(&second, &left);
  std::printf("%d %d %ld\n", result, errno == EINTR, left.tv_nsec);
  sender.join();
  deferred.join();
}

void signal_from_outside() {  // the test sends it
  install(SIGTERM);
  say("ready");
  while (sem_wait(&posted) != 0) {
  }
  say("posted");
}

void thread_signals() {
  install(SIGUSR1);
  sigset_t set;
  sigemptyset(&set);
  sigaddset(&set, SIGUSR2);
  pthread_sigmask(SIG_BLOCK, &set, nullptr);
  std::thread sleeper([] {
    usleep(10'000'000);
    say("woken");
  });
  std::thread waiter([&] {
    int signal = 0;
    sigwait(&set, &signal);
    say(signal == SIGUSR2 ? "sigwait" : "?");
  });
  std::this_thread::sleep_for(1ms);
  pthread_kill(sleeper.native_handle(), SIGUSR1);
  say(handled ? "handled" : "not handled");
  pthread_kill(waiter.native_handle(), SIGUSR2);
  sleeper.join();
  waiter.join();
}

void cancel() {
  static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
  static pthread_cond_t never = PTHREAD_COND_INITIALIZER;
  const std::vector<std::function<void()>> waits = {
      [] {
        pthread_mutex_lock(&mutex);
        pthread_cleanup_push([](void *held) { pthread_mutex_unlock(static_cast<pthread_mutex_t *>(held)); }, &mutex);
        pthread_cond_wait(&never, &mutex);
        pthread_cleanup_pop(1);
      },
      [] { sleep(1000); },
      [] { sem_wait(&posted); },
      [] {
        int ends[2];
        char byte;
        if (pipe(ends) == 0 && read(ends[0], &byte, 1) == 0) say("?");
      },
      [] { poll(nullptr, 0, -1); }};
  sem_init(&posted, 0, 0);
  for (const auto &wait : waits) {
    pthread_t handle;
    pthread_create(
        &handle, nullptr,
        [](void *what) -> void * {
          struct Unwound {
            ~Unwound() { say("unwound"); }
          } unwound;
          (*static_cast<const std::function<void()> *>(what))();
          return nullptr;
        },
        const_cast<void *>(static_cast<const void *>(&wait)));
    usleep(1000);
    pthread_cancel(handle);
    void *result = nullptr;
    pthread_join(handle, &result);
    say(result == PTHREAD_CANCELED ? "cancelled" : "not cancelled");
    if (pthread_mutex_trylock(&mutex) == 0) pthread_mutex_unlock(&mutex);
    else say("mutex was not given back");
  }
}

struct Noisy {
  const char *what;
  ~Noisy() { say(what); }
};

void destructors() {
  static pthread_key_t key;
  pthread_key_create(&key, [](void *) {
    std::this_thread::sleep_for(1ms);
    say("key");
  });
  std::thread([] {
    thread_local Noisy noisy{"thread_local"};
    pthread_setspecific(key, &noisy);
    say("thread");
  }).join();
  say("joined");
  std::thread detached([] {
    std::this_thread::sleep_for(2ms);
    say("detached");
  });
  detached.detach();
  static struct Joins {
    std::thread thread{[] {
      std::this_thread::sleep_for(5ms);
      say("joined by a static destructor");
    }};
    ~Joins() { thread.join(); }
  } joins;
  atexit([] { say("atexit"); });
}

void main_leaves() {
  std::thread([] {
    std::this_thread::sleep_for(3ms);
    say("after main");
  }).detach();
  atexit([] { say("atexit"); });
  pthread_exit(nullptr);
}

void exits(void (*how)()) {
  std::thread other([how] {
    std::this_thread::sleep_for(1ms);
    how();
  });
  atexit([] { say("atexit"); });
  std::this_thread::sleep_for(1h);
}

void children() {
  std::thread other([] { std::this_thread::sleep_for(1h); });
  other.detach();
  std::vector<int> statuses;
  const pid_t copy = fork();
  if (copy == 0) {
    std::thread inner([] { usleep(1000); });
    inner.join();
    _exit(time(nullptr) > 1'750'000'000 ? 10 : 11);  // its clock is the real one
  }
  int status = 0;
  waitpid(copy, &status, 0);
  statuses.push_back(WEXITSTATUS(status));
  char name[] = "sh", flag[] = "-c", text[] = "test -z \"$LD_PRELOAD\" && sleep 0.05 && exit 12";
  char *words[] = {name, flag, text, nullptr};
  pid_t spawned;
  posix_spawnp(&spawned, "sh", nullptr, nullptr, words, environ);
  waitpid(spawned, &status, 0);
  statuses.push_back(WEXITSTATUS(status));
  statuses.push_back(WEXITSTATUS(system("exit 13")));
  FILE *out = popen("echo 14", "r");
  int number = 0;
  if (std::fscanf(out, "%d", &number) == 1) statuses.push_back(number);
  pclose(out);
  for (const int one_of : statuses) std::printf("%d ", one_of);
  std::puts("");
}

void entropy() {
  std::uint64_t words[4] = {};
  if (getrandom(&words[0], 8, 0) != 8 || getentropy(&words[1], 8) != 0) std::abort();
  std::ifstream("/dev/urandom").read(reinterpret_cast<char *>(&words[2]), 8);
  FILE *file = std::fopen("/dev/random", "rb");
  if (std::fread(&words[3], 8, 1, file) != 1) std::abort();
  for (const auto word : words) std::printf("%016llx ", static_cast<unsigned long long>(word));
  std::random_device device;
  std::uint64_t again = 0;
  const int opened = open("/dev/urandom", O_RDONLY);
  if (read(opened, &again, 8) != 8) std::abort();
  const auto raw = static_cast<int>(syscall(SYS_openat, AT_FDCWD, "/dev/urandom", O_RDONLY));
  if (read(raw, &words[2], 8) != 8) std::abort();
  dlopen("libuuid.so.1", RTLD_NOW | RTLD_GLOBAL);
  void *const found = dlsym(RTLD_DEFAULT, "uuid_generate");
  if (found != nullptr) reinterpret_cast<void (*)(std::uint64_t *)>(found)(words);
  std::printf("%016llx ", static_cast<unsigned long long>(words[0]));
  if (syscall(SYS_getrandom, &words[0], 8, 0) != 8) std::abort();
  std::string uuid;
  std::ifstream("/proc/sys/kernel/random/uuid") >> uuid;
  std::printf("%s %08x %016llx %016llx %016llx\n", uuid.c_str(), device(), static_cast<unsigned long long>(again),
              static_cast<unsigned long long>(words[0]), static_cast<unsigned long long>(words[2]));
}

void real_timers() {
  alarm(0);
  alarm(1000);
  alarm(1000);
  itimerval once{};
  once.it_value.tv_sec = 1000;
  setitimer(ITIMER_REAL, &once, nullptr);
  timer_t timer;
  timer_create(CLOCK_MONOTONIC, nullptr, &timer);
  std::puts("made");
}

void processors() {
  cpu_set_t set;
  sched_getaffinity(0, sizeof set, &set);
  std::printf("%u %ld %d %d %d\n", std::thread::hardware_concurrency(), sysconf(_SC_NPROCESSORS_ONLN), get_nprocs(),
              CPU_COUNT(&set), sched_getcpu());
}

void clocks() {
  timespec first, mono, raw;
  timeval day;
  clock_gettime(CLOCK_REALTIME, &first);
  clock_gettime(CLOCK_MONOTONIC, &mono);
  syscall(SYS_clock_gettime, CLOCK_MONOTONIC_RAW, &raw);
  gettimeofday(&day, nullptr);
  std::printf("%ld %ld %ld %ld %ld\n", first.tv_sec, mono.tv_sec, raw.tv_sec, day.tv_sec, time(nullptr));
  sleep(3600);
  clock_gettime(CLOCK_REALTIME, &mono);
  std::printf("%ld\n", mono.tv_sec - first.tv_sec);
  const std::int64_t before = now_us();
  poll(nullptr, 0, 250);
  timeval limit{0, 250'000};
  select(0, nullptr, nullptr, nullptr, &limit);
  const int set = epoll_create1(0);
  epoll_event event;
  epoll_wait(set, &event, 1, 500);
  std::printf("%lld\n", static_cast<long long>(now_us() - before));
}

void busy() {  // loops that do not wait must not stop time
  std::atomic<bool> over{false};
  std::thread other([&] {
    std::this_thread::sleep_for(20ms);
    over = true;
  });
  while (!over) std::this_thread::yield();
  say("yielded");
  const auto until = std::chrono::steady_clock::now() + 10ms;
  while (std::chrono::steady_clock::now() < until) {
  }
  say("looked");
  pollfd nothing{-1, 0, 0};
  over = false;
  std::thread third([&] {
    std::this_thread::sleep_for(5ms);
    over = true;
  });
  while (!over) poll(&nothing, 1, 0);
  say("polled");
  other.join();
  third.join();
}

void outside_pipe() {  // the test writes to our standard input after a while
  std::thread other([] {
    for (int i = 0; i < 3; ++i) std::this_thread::sleep_for(1ms);
    say("others go on");
  });
  char byte = 0;
  if (read(0, &byte, 1) == 1) std::printf("read %c\n", byte);
  other.join();
}

void outside_unseen() {  // stdio reads below our functions: the service thread finds it
  std::thread other([] {
    std::this_thread::sleep_for(1ms);
    say("others go on");
  });
  char line[8];
  if (std::fgets(line, sizeof line, stdin) != nullptr) std::printf("read %s", line);
  std::this_thread::sleep_for(1ms);
  other.join();
  std::puts("joined");
}

void inner_files() {
  int ends[2], pair[2];
  if (pipe(ends) != 0 || socketpair(AF_UNIX, SOCK_STREAM, 0, pair) != 0) std::abort();
  std::thread reader([&] {
    char byte;
    if (read(ends[0], &byte, 1) == 1) say("pipe");
    if (recv(pair[0], &byte, 1, 0) == 1) say("socket");
  });
  std::this_thread::sleep_for(7ms);
  if (write(ends[1], "x", 1) != 1) std::abort();
  say("wrote");
  std::this_thread::sleep_for(7ms);
  if (send(pair[1], "x", 1, 0) != 1) std::abort();
  reader.join();
}

void fortified() {  // lengths that the compiler does not know
  volatile nfds_t none = 0;
  volatile std::size_t two = 2;
  volatile int reads = O_RDONLY;
  pollfd list[2];
  char bytes[8];
  int ends[2], pair[2];
  if (pipe(ends) != 0 || socketpair(AF_UNIX, SOCK_STREAM, 0, pair) != 0) std::abort();
  poll(list, none, 5);
  say("polled");
  std::thread writer([&] {
    for (const int one_of : {ends[1], pair[1], pair[1]}) {
      std::this_thread::sleep_for(1ms);
      if (write(one_of, "ab", 2) != 2) std::abort();
    }
  });
  if (read(ends[0], bytes, two) == 2) say("read");
  if (recv(pair[0], bytes, two, 0) == 2) say("recv");
  if (recvfrom(pair[0], bytes, two, 0, nullptr, nullptr) == 2) say("recvfrom");
  writer.join();
  const timespec pause{0, 1'000'000};
  ppoll(list, none, &pause, nullptr);
  say("ppolled");
  unsigned char drawn[8] = {};
  if (read(open("/dev/urandom", reads), drawn, 4 * two) == 8)
    for (const unsigned char byte : drawn) std::printf("%02x", byte);
  std::puts("");
}

using Write = ssize_t (*)(int, char *, std::size_t);

ssize_t in_two_parts(int to, char *from, std::size_t size, bool message) {
  iovec parts[2] = {{from, size / 3}, {from + size / 3, size - size / 3}};
  msghdr head{};
  head.msg_iov = parts;
  head.msg_iovlen = 2;
  return message ? sendmsg(to, &head, 0) : writev(to, parts, 2);
}

void full() {  // a pipe and sockets that have no room for all of it
  int ends[2], pair[2], datagrams[2];
  if (pipe(ends) != 0 || socketpair(AF_UNIX, SOCK_STREAM, 0, pair) != 0 ||
      socketpair(AF_UNIX, SOCK_DGRAM, 0, datagrams) != 0)
    std::abort();
  const std::pair<int *, Write> ways[] = {
      {ends, [](int to, char *from, std::size_t size) { return write(to, from, size); }},
      {pair, [](int to, char *from, std::size_t size) { return send(to, from, size, 0); }},
      {pair, [](int to, char *from, std::size_t size) { return sendto(to, from, size, 0, nullptr, 0); }},
      {ends, [](int to, char *from, std::size_t size) { return in_two_parts(to, from, size, false); }},
      {pair, [](int to, char *from, std::size_t size) { return in_two_parts(to, from, size, true); }},
      {datagrams,
       [](int to, char *from, std::size_t size) {
         std::size_t sent = 0;
         while (sent < size) sent += static_cast<std::size_t>(in_two_parts(to, from, 10'000, true));
         return static_cast<ssize_t>(sent);
       }},
  };
  std::vector<char> sent(1'000'000);
  for (std::size_t i = 0; i < sent.size(); ++i) sent[i] = static_cast<char>(i % 10'000 % 251);
  for (const auto &[both, way] : ways) {
    std::thread reader([from = both[0], &sent] {
      std::vector<char> bytes;
      while (bytes.size() < sent.size()) {
        std::this_thread::sleep_for(1ms);
        const std::size_t before = bytes.size();
        bytes.resize(before + sent.size() / 3);
        const ssize_t part = read(from, &bytes[before], sent.size() / 3);
        if (part <= 0) std::abort();
        bytes.resize(before + static_cast<std::size_t>(part));
      }
      say(bytes == sent ? "read" : "read something else");
    });
    const ssize_t wrote = way(both[1], sent.data(), sent.size());
    say(wrote == static_cast<ssize_t>(sent.size()) ? "wrote all" : "?");
    reader.join();
  }
}

void processor_time() {
  rusage used;
  tms ticks;
  const clock_t before = times(&ticks);
  if (getrusage(RUSAGE_SELF, &used) != 0) std::abort();
  const long begin_s = used.ru_utime.tv_sec;
  sleep(2);
  if (getrusage(RUSAGE_SELF, &used) != 0) std::abort();
  std::printf("%ld %ld %ld\n", used.ru_utime.tv_sec - begin_s, (times(nullptr) - before) / sysconf(_SC_CLK_TCK),
              used.ru_nvcsw + used.ru_nivcsw);
}

void crash() {
  std::thread([] { *static_cast<volatile int *>(nullptr) = 1; }).join();
}

}  // namespace

int main(int, char **argv) {
  const std::map<std::string, void (*)()> cases = {
      {"itself", itself}, {"cycle", cycle}, {"everybody", everybody}, {"handler_posts", handler_posts},
      {"signal_from_outside", signal_from_outside}, {"thread_signals", thread_signals}, {"cancel", cancel},
      {"destructors", destructors}, {"main_leaves", main_leaves}, {"children", children}, {"entropy", entropy},
      {"real_timers", real_timers},
      {"processors", processors}, {"clocks", clocks}, {"busy", busy}, {"outside_pipe", outside_pipe},
      {"outside_unseen", outside_unseen}, {"inner_files", inner_files}, {"full", full}, {"fortified", fortified},
      {"processor_time", processor_time}, {"crash", crash},
      {"exit", [] { exits([] { std::exit(3); }); }},
      {"_exit", [] { exits([] { _exit(4); }); }},
  };
  cases.at(argv[1])();
}
