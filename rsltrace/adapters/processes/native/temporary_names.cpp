// Names of temporary files: libc draws them from the machine's chance.
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstring>

#include "entropy.h"
#include "real.h"
#include "scheduler.h"

using namespace rsltrace;

namespace {

constexpr char LETTERS[] = "abcdefghijklmnopqrstuvwxyz0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ";
constexpr std::size_t DRAWN = 6;
constexpr int TRIES = 238'328;  // as libc

// A sequence of its own: how many names are taken already must not change what the program draws.
void draw_name(char *out) {
  static std::uint64_t state = seed() ^ 0x6e616d6573;
  std::uint64_t word = split_mix(state);
  for (std::size_t i = 0; i < DRAWN; ++i, word /= sizeof LETTERS - 1) out[i] = LETTERS[word % (sizeof LETTERS - 1)];
}

// Put names in the place of XXXXXX, before `suffix` more characters, until one is free.
template <typename Make>
int make(char *path, int suffix, Make make_one) {
  const std::size_t length = std::strlen(path);
  const std::size_t after = DRAWN + static_cast<std::size_t>(suffix);
  if (suffix < 0 || length < after || std::strncmp(path + length - after, "XXXXXX", DRAWN) != 0)
    return errno = EINVAL, -1;
  for (int tries = 0; tries < TRIES; ++tries) {
    draw_name(path + length - after);
    const int made = make_one(path);
    if (made >= 0 || errno != EEXIST) return made;
  }
  return errno = EEXIST, -1;
}

int make_file(char *path, int suffix, int flags) {
  const int kept = flags & ~O_ACCMODE;
  return make(path, suffix, [kept](const char *name) {
    return REAL(open)(name, O_RDWR | O_CREAT | O_EXCL | kept, S_IRUSR | S_IWUSR);
  });
}

// A name that no file has, in the place of `path`.
int make_name(char *path) {
  return make(path, 0, [](const char *name) { return access(name, F_OK) == 0 ? (errno = EEXIST, -1) : 0; });
}

// The name that libc has made, with other letters at its end.
char *other_name(char *path) {
  if (path == nullptr || me() == nullptr) return path;
  std::memcpy(path + std::strlen(path) - DRAWN, "XXXXXX", DRAWN);
  return make_name(path) == 0 ? path : nullptr;
}

}  // namespace

#define RSLTRACE_TEMPORARY(name, suffix, flags, parameters, arguments)   \
  RSLTRACE_EXPORT int name parameters {                                  \
    if (me() == nullptr) return REAL(name) arguments;                    \
    return make_file(path, suffix, flags);                               \
  }

RSLTRACE_TEMPORARY(mkstemp, 0, 0, (char *path), (path))
RSLTRACE_TEMPORARY(mkstemp64, 0, 0, (char *path), (path))
RSLTRACE_TEMPORARY(mkostemp, 0, flags, (char *path, int flags), (path, flags))
RSLTRACE_TEMPORARY(mkostemp64, 0, flags, (char *path, int flags), (path, flags))
RSLTRACE_TEMPORARY(mkstemps, suffix, 0, (char *path, int suffix), (path, suffix))
RSLTRACE_TEMPORARY(mkstemps64, suffix, 0, (char *path, int suffix), (path, suffix))
RSLTRACE_TEMPORARY(mkostemps, suffix, flags, (char *path, int suffix, int flags), (path, suffix, flags))
RSLTRACE_TEMPORARY(mkostemps64, suffix, flags, (char *path, int suffix, int flags), (path, suffix, flags))

RSLTRACE_EXPORT char *mkdtemp(char *path) noexcept {
  if (me() == nullptr) return REAL(mkdtemp)(path);
  return make(path, 0, [](const char *name) { return mkdir(name, S_IRWXU); }) == 0 ? path : nullptr;
}

RSLTRACE_EXPORT char *mktemp(char *path) noexcept {
  if (me() == nullptr) return REAL(mktemp)(path);
  if (make_name(path) != 0) *path = 0;
  return path;
}

RSLTRACE_EXPORT char *tmpnam(char *path) noexcept { return other_name(REAL(tmpnam)(path)); }
RSLTRACE_EXPORT char *tmpnam_r(char *path) noexcept { return other_name(REAL(tmpnam_r)(path)); }

RSLTRACE_EXPORT char *tempnam(const char *folder, const char *prefix) noexcept {
  return other_name(REAL(tempnam)(folder, prefix));
}
