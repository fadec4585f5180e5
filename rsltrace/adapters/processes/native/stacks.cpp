// Who waits for what, and where: for messages about deadlocks and processes that hang.
#include <cxxabi.h>
#include <dlfcn.h>
#include <execinfo.h>

#include <cstdio>
#include <cstdlib>
#include <memory>

#include "real.h"
#include "scheduler.h"
#include "threads.h"

namespace rsltrace {
namespace {

std::string hex(std::uintptr_t value) {
  char text[32];
  std::snprintf(text, sizeof text, "%#lx", static_cast<unsigned long>(value));
  return text;
}

std::string module(const Dl_info &info, std::uintptr_t address, bool code) {
  const std::string path = info.dli_fname == nullptr ? "?" : info.dli_fname;
  return (code ? path : path.substr(path.rfind('/') + 1)) + "+" + hex(address - reinterpret_cast<std::uintptr_t>(info.dli_fbase));
}

// "name" of what is there if it is exported, else "module+offset", of code with the module's path: the run finds its line.
std::string symbol(const void *where, bool code) {
  Dl_info info{};
  if (dladdr(where, &info) == 0) return hex(reinterpret_cast<std::uintptr_t>(where));
  const std::string place = module(info, reinterpret_cast<std::uintptr_t>(where), code);
  if (info.dli_sname == nullptr) return place;
  int status = 0;
  const std::unique_ptr<char, void (*)(void *)> name(
      abi::__cxa_demangle(info.dli_sname, nullptr, nullptr, &status), std::free);
  return std::string(status == 0 ? name.get() : info.dli_sname) + (code ? " (" + place + ")" : "");
}

bool ours(const void *where) {
  Dl_info here{}, there{};
  return dladdr(reinterpret_cast<const void *>(&ours), &here) != 0 && dladdr(where, &there) != 0 &&
         here.dli_fbase == there.dli_fbase;
}

std::string title(const Thread &thread) {
  char name[32] = "";
  pthread_getname_np(thread.handle, name, sizeof name);
  return "thread " + std::to_string(thread.number) + (*name == 0 ? "" : " (" + std::string(name) + ")");
}

Thread *owner_of(const Thread &thread) {
  if (thread.kind != Kind::MUTEX || thread.granted) return nullptr;
  return owner(static_cast<const pthread_mutex_t *>(thread.address)->__data.__owner);
}

std::string doing(const Thread &thread) {
  switch (thread.state) {
    case State::RUNNING: return "runs";
    case State::READY: return "is ready to run";
    case State::ENDED: return "has ended";
    case State::OUTSIDE: return std::string("is outside of the simulation, in ") + thread.what;
    case State::WAITING: break;
  }
  std::string text = std::string("waits in ") + thread.what;
  if (thread.kind == Kind::JOIN) return text + " for " + title(*static_cast<const Thread *>(thread.address));
  if (thread.address != nullptr && thread.kind != Kind::FILES && thread.kind != Kind::ROS)
    text += " at " + symbol(thread.address, false);
  if (const Thread *other = owner_of(thread))
    text += &thread == other ? ", which it holds itself" : ", which " + title(*other) + " holds";
  return text;
}

std::string with_stack(Thread &thread) {
  std::string text = "  " + title(thread) + " " + doing(thread);
  if (thread.state == State::ENDED || !order(thread, Order::TELL)) return text;
  bool outside = false;  // our own frames come first
  for (int i = 0; i < thread.depth; ++i) {
    outside |= i > 0 && !ours(thread.frames[i]);
    if (outside) text += "\n      " + symbol(static_cast<char *>(thread.frames[i]) - 1, true);
  }
  return text;
}

}  // namespace

void note_frames(Thread &thread) { thread.depth = backtrace(thread.frames, FRAMES_MAX); }

std::string describe_threads() {
  std::string text;
  for (Thread *thread : all())
    if (thread->state != State::ENDED) text += (text.empty() ? "" : "\n") + with_stack(*thread);
  return text;
}

// A lock that can never be had: each of these threads waits for one that the next holds.
void lock_cycle(Thread &thread) {
  std::vector<Thread *> cycle{&thread};
  for (Thread *next = owner_of(thread); next != &thread; next = owner_of(*next)) {
    const bool waits = next != nullptr && next->state == State::WAITING && next->kind == Kind::MUTEX;
    if (!waits || next->own.deadline_ns != NEVER_NS || cycle.size() > all().size()) return;
    cycle.push_back(next);
  }
  std::string text = "deadlock: threads wait for each other's mutexes, or for their own";
  for (Thread *one : cycle) text += "\n" + with_stack(*one);
  report(text);
}

}  // namespace rsltrace
