// What clocks show where the job has other ones for some nodes: the loop is asked, once for all that
// the process does until it waits again, unless the clock advances by being looked at.
#include <map>

#include "link.h"

namespace rsltrace {

namespace {

// What clocks show, by the nodes that they are of, since the process was let go on for the last time.
struct Shown {
  std::uint64_t since = 0;
  std::map<std::uint32_t, std::int64_t> by_node;
};

Shown &shown_so_far() {
  static auto *all = new Shown;
  if (all->since != times_let_go()) *all = {times_let_go(), {}};
  return *all;
}

}  // namespace

std::int64_t shown_ns(std::uint32_t node, bool look) {
  if (!has_own_clocks() || !linked()) return now_ns();
  auto &so_far = shown_so_far().by_node;
  const auto found = so_far.find(node);
  if (found != so_far.end()) return found->second;
  Writer body;
  body.number(node);
  body.number(static_cast<std::uint32_t>(look));
  const auto answer = ask(Say::CLOCK, body);
  Reader reader(answer.data(), answer.size());
  const auto shown = reader.number<std::int64_t>();
  if (reader.number<std::uint32_t>() != 0) so_far[node] = shown;
  return shown;
}

std::uint32_t owner_of_new_clock() {
  const auto answer = ask(Say::CLOCK_OWNER, Writer());
  return Reader(answer.data(), answer.size()).number<std::uint32_t>();
}

}  // namespace rsltrace
