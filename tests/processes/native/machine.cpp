// What a program can find out about the machine and about chance, beside time: `machine NAME`.
#include <sched.h>
#include <sys/auxv.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timeb.h>
#include <sys/times.h>
#include <threads.h>
#include <time.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <map>
#include <string>

namespace {

void processor() {
  unsigned cpu = 99, node = 99, again = 99;
  cpu_set_t set;
  CPU_ZERO(&set);
  if (getcpu(&cpu, &node) != 0 || syscall(SYS_getcpu, &again, nullptr, nullptr) != 0) std::abort();
  const long bytes = syscall(SYS_sched_getaffinity, 0, sizeof set, &set);
  std::printf("%u %u %u %d %d\n", cpu, node, again, CPU_COUNT(&set), bytes > 0);
}

void calls() {  // past the functions of libc
  timeval day;
  time_t seconds = 0;
  tms ticks;
  rusage used;
  if (syscall(SYS_gettimeofday, &day, nullptr) != 0 || syscall(SYS_time, &seconds) != seconds) std::abort();
  const long before = syscall(SYS_times, &ticks);
  sleep(2);
  if (syscall(SYS_getrusage, RUSAGE_SELF, &used) != 0) std::abort();
  const long passed = (syscall(SYS_times, &ticks) - before) / sysconf(_SC_CLK_TCK);
  timeb old;
#pragma GCC diagnostic ignored "-Wdeprecated-declarations"
  ftime(&old);
  std::printf("%ld %ld %ld %ld %ld\n", day.tv_sec, seconds, passed, used.ru_nvcsw, old.time);
}

void start() {  // what the kernel gives a program when it starts, for its own chance
  const auto *random = reinterpret_cast<const unsigned char *>(getauxval(AT_RANDOM));
  for (int i = 0; i < 16; ++i) std::printf("%02x", random[i]);
  std::puts("");
}

void names() {
  char folder[] = "/tmp/rsltrace_XXXXXX";
  if (mkdtemp(folder) == nullptr) std::abort();
  std::puts(folder);
  const std::string inside = std::string(folder) + "/XXXXXX";
  std::string file = inside, ending = inside + ".txt", flags = inside;
  if (mkstemp(file.data()) < 0 || mkstemps(ending.data(), 4) < 0 || mkostemp(flags.data(), 0) < 0) std::abort();
  char wrong[] = "/tmp/none";
  std::printf("%s %s %s %d\n", file.c_str() + sizeof folder, ending.c_str() + sizeof folder,
              flags.c_str() + sizeof folder, mkstemp(wrong));
  for (const auto &one : {file, ending, flags}) unlink(one.c_str());
  rmdir(folder);
  char name[L_tmpnam], *other = tempnam("/none", "ab"), made[] = "/tmp/XXXXXX";
  std::printf("%s %s %s %s\n", tmpnam(name), other, mktemp(made), *mktemp(wrong) == 0 ? "no" : wrong);
  std::free(other);
}

std::int64_t now_ms() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1000 + now.tv_nsec / 1'000'000;
}

mtx_t lock;
cnd_t changed;
once_flag once = ONCE_FLAG_INIT;
bool is_set = false;

int set_later(void *) {
  const timespec pause{0, 300'000'000};
  thrd_sleep(&pause, nullptr);
  mtx_lock(&lock);
  is_set = true;
  cnd_broadcast(&changed);
  thrd_sleep(&pause, nullptr);  // others wait for the lock
  mtx_unlock(&lock);
  return 7;
}

void c11() {
  const std::int64_t begun = now_ms();
  thrd_t other;
  timespec until;
  int result = 0;
  call_once(&once, [] { mtx_init(&lock, mtx_timed | mtx_recursive), cnd_init(&changed); });
  if (thrd_create(&other, set_later, nullptr) != thrd_success) std::abort();
  mtx_lock(&lock);
  timespec_get(&until, TIME_UTC);
  until.tv_nsec += 100'000'000;
  std::printf("%d ", cnd_timedwait(&changed, &lock, &until) == thrd_timedout);
  while (!is_set) cnd_wait(&changed, &lock);
  std::printf("%d %lld ", mtx_trylock(&lock) == thrd_success, static_cast<long long>(now_ms() - begun));
  mtx_unlock(&lock);
  mtx_unlock(&lock);
  thrd_yield();
  if (thrd_join(other, &result) != thrd_success) std::abort();
  std::printf("%d %lld\n", result, static_cast<long long>(now_ms() - begun));
}

}  // namespace

int main(int, char **argv) {
  const std::map<std::string, void (*)()> cases = {
      {"processor", processor}, {"calls", calls}, {"start", start}, {"names", names}, {"c11", c11}};
  cases.at(argv[1])();
}
