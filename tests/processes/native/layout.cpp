// Where memory lies, after as much work as is asked for: `layout MILLIONS`.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

int main(int, char **argv) {
  volatile unsigned long steps = std::strtoul(argv[1], nullptr, 10) * 1'000'000;
  while (steps > 0) steps = steps - 1;
  constexpr int THREADS = 20;
  std::vector<void *> found(THREADS);
  std::vector<std::thread> threads;
  for (void *&one : found)
    threads.emplace_back([&one] {
      one = std::malloc(100);
      std::this_thread::sleep_for(std::chrono::seconds(1));
    });
  for (auto &thread : threads) thread.join();
  for (const void *one : found) std::printf("%p\n", one);
}
