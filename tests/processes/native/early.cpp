// A library that does at its start what belongs to the run (with LIBRARY), and a program that has it.
// What it prints: how long the library has been there, what it drew, how often its thread has slept.
#include <chrono>
#include <cstdio>
#include <random>
#include <thread>

void tell();

#ifdef LIBRARY

using Clock = std::chrono::system_clock;

static struct Early {
  Clock::time_point made = Clock::now();
  unsigned drawn = std::random_device{}();
  int slept = 0;
  Early() {
    std::thread([this] {
      for (; slept < 3; ++slept) std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }).detach();
  }
} early;

void tell() {
  const std::chrono::nanoseconds age = Clock::now() - early.made;
  std::printf("%lld %u %d\n", static_cast<long long>(age.count()), early.drawn, early.slept);
}

#else

int main() {
  tell();
  std::this_thread::sleep_for(std::chrono::milliseconds(10));
  tell();
}

#endif
