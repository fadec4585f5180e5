// Stands before rmw, rcl's timers and tracetools in a process of a native run: passes every call on
// to the real middleware, and notes it in a file that the run maps, too. What is in the file outlives
// the process, however that ends. The other side is rsltrace/native/processes/record_file.py.
#include <dlfcn.h>
#include <fcntl.h>
#include <fnmatch.h>
#include <pthread.h>
#include <rcl/node.h>
#include <rcl/service.h>
#include <rcl/subscription.h>
#include <rcl/timer.h>
#include <rmw/error_handling.h>
#include <rmw/rmw.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <shared_mutex>
#include <sstream>
#include <unordered_map>

#include "../native/qos.h"
#include "../native/typesupport.h"
#include "../native/wire.h"
#include "hash64.h"

#define EXPORT extern "C" __attribute__((visibility("default")))

using rsltrace::MessageCodec;
using rsltrace::write_qos;
using rsltrace::Writer;

namespace {

enum class Kind : std::uint32_t {
  NODE = 1,
  PUBLISHER,
  SUBSCRIPTION,
  SERVICE,
  CLIENT,
  TIMER,
  TIMER_OF,
  CALLBACK,
  NAME,
  TAKE,
  CALL,
  BEGIN,
  END,
  WAIT,
  SENDING,
  SENT,
  LOST,
};

using Data = std::vector<std::uint8_t>;

std::int64_t now_ns(clockid_t clock = CLOCK_MONOTONIC) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * INT64_C(1'000'000'000) + now.tv_nsec;
}

// The next definition of a function after this library's; in a process that has loaded ROS for
// itself (Python) that is in no global scope.
void *real(const char *name) {
  if (void *found = dlsym(RTLD_NEXT, name)) return found;
  for (const char *library : {"librmw_implementation.so", "librcl.so", "libtracetools.so"}) {
    void *handle = dlopen(library, RTLD_LAZY | RTLD_NOLOAD);
    if (handle == nullptr) continue;
    if (void *found = dlsym(handle, name)) return found;
  }
  std::fprintf(stderr, "rsltrace: nothing has %s\n", name);
  std::abort();
}

#define REAL(name)                                                       \
  ([] {                                                                  \
    static const auto found = reinterpret_cast<decltype(&::name)>(real(#name)); \
    return found;                                                        \
  }())

// -- the file -----------------------------------------------------------------------------------

// What is written goes around in a ring behind the head; all counts only grow. `is_writing` is set
// before the time of a record is read and cleared once it is there: who finds it clear sees all
// records of before.
//
// If only the last records are kept, what makes entities, and a copy of what checks are about, is in
// a ring of its own behind the other one, which is read all the time; in the other one new records
// take the place of the oldest.
// `reserved` says before they do; `starts` is where the first record of each part of it begins.
constexpr std::size_t PARTS = 256;

struct Head {
  std::uint64_t magic;
  std::uint64_t capacity;
  std::atomic<std::uint64_t> written;
  std::atomic<std::uint64_t> read;
  std::atomic<std::uint64_t> is_writing;
  std::atomic<std::uint64_t> lost;
  std::int64_t cpu_ns;  // processor time before all records: of what has become this program
  std::atomic<std::uint64_t> reserved;
  std::atomic<std::uint64_t> made_written;
  std::atomic<std::uint64_t> made_read;
  std::atomic<std::int64_t> triggered_ns;  // the last message that the last records are kept for
  std::atomic<std::uint64_t> trigger;      // the id of whoever sent or got it
  std::atomic<std::uint64_t> ended;        // ENDED and the exit status, unless it was killed
  std::atomic<std::uint64_t> unchecked;    // copies that found no room
  std::atomic<std::uint64_t> starts[PARTS];
};

constexpr std::uint64_t MAGIC = 0x32656361'72746c73;
constexpr std::size_t HEAD = 4096;
constexpr std::size_t MADE = 1 << 20;
constexpr std::uint64_t ENDED = 0x100;
static_assert(sizeof(Head) <= HEAD);

// What the run wants: "capacity, whether only the last records are kept, the largest message whose
// bytes are kept", then names of topics and services, a line each: +those whose messages are kept,
// -those whose are not, !those for which the last records are kept, ?those that checks are about.
struct Settings {
  std::size_t capacity = 32 << 20;
  bool keeps_last = false;
  std::size_t largest = 8 << 20;
  std::vector<std::string> names;

  Settings() {
    const char *given = std::getenv("RSLTRACE_OBSERVER_SETTINGS");
    if (given == nullptr) return;
    std::istringstream text(given);
    text >> capacity >> keeps_last >> largest;
    largest = std::min(largest, capacity / 4);
    for (std::string name; std::getline(text, name);)
      if (!name.empty()) names.push_back(name);
  }

  bool has(char mark, const char *name) const {
    return std::any_of(names.begin(), names.end(), [=](const std::string &one) {
      return one[0] == mark && fnmatch(one.c_str() + 1, name, 0) == 0;
    });
  }
};

const Settings &settings() {
  static const auto *made = new Settings;
  return *made;
}

struct RecordHead {
  std::uint32_t size;
  Kind kind;
  std::int64_t steady_ns;
  std::int64_t wall_ns;  // read after it: what begins and ends by the one lasts longer than by the other
  std::uint32_t thread;
  std::uint32_t spent_ns;  // by this library for this record
};

// The fields of a record of known size, without memory from the heap.
class Fields {
 public:
  template <typename Number>
  void number(Number value) {
    raw(&value, sizeof value);
  }
  void raw(const void *data, std::size_t size) {
    std::memcpy(bytes_ + size_, data, size);
    size_ += size;
  }
  const std::uint8_t *data() const { return bytes_; }
  std::size_t size() const { return size_; }

 private:
  std::uint8_t bytes_[80];
  std::size_t size_ = 0;
};

bool is_forked = false;
// Whether this thread has noted anything since it waited last.
thread_local bool is_active = false;

class Ring {
 public:
  Ring() {
    const char *folder = std::getenv("RSLTRACE_OBSERVER");
    if (folder == nullptr) return;
    const std::string path =
        std::string(folder) + "/" + std::to_string(getpid()) + "." + std::to_string(now_ns());
    const int file = open(path.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (file < 0) return;
    const std::size_t capacity = settings().capacity;
    const std::size_t size = HEAD + capacity + (settings().keeps_last ? MADE : 0);
    // Not sparse: on a full disk a process would be killed as it writes.
    if (posix_fallocate(file, 0, static_cast<off_t>(size)) == 0) {
      void *found =
          mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, file, 0);
      if (found != MAP_FAILED) {
        head_ = static_cast<Head *>(found);
        head_->capacity = capacity;
        head_->cpu_ns = now_ns(CLOCK_PROCESS_CPUTIME_ID);
        std::atomic_thread_fence(std::memory_order_seq_cst);
        head_->magic = MAGIC;
        pthread_atfork(nullptr, nullptr, [] { is_forked = true; });  // the file is its parent's
        on_exit([](int status, void *head) {
          if (!is_forked) static_cast<Head *>(head)->ended.store(ENDED | (status & 0xff));
        }, head_);
      }
    }
    close(file);
  }

  bool is_open() const { return head_ != nullptr && !is_forked; }

  void add(Kind kind, const void *fields, std::size_t fields_size, std::int64_t begun_ns,
           const void *data = nullptr, std::size_t data_size = 0) {
    is_active = kind != Kind::WAIT;
    static thread_local const auto thread = static_cast<std::uint32_t>(syscall(SYS_gettid));
    const std::lock_guard<std::mutex> lock(lock_);
    head_->is_writing.store(1);
    const bool is_made = settings().keeps_last && kind <= Kind::NAME;
    if (lost_ > 0 && !is_made) {  // what follows lacks something
      if (put(false, Kind::LOST, thread, 0, &lost_, sizeof lost_, nullptr, 0)) lost_ = 0;
    }
    if ((lost_ > 0 && !is_made) ||
        !put(is_made, kind, thread, begun_ns, fields, fields_size, data, data_size)) {
      ++lost_;
      head_->lost.fetch_add(1);
    }
    head_->is_writing.store(0, std::memory_order_release);
  }

  // Add a copy that the run reads at once, without the data if that is too large. Half of the ring
  // is left for what makes entities.
  void show(Kind kind, const Fields &fields, const Data &data) {
    const auto thread = static_cast<std::uint32_t>(syscall(SYS_gettid));
    const std::lock_guard<std::mutex> lock(lock_);
    const std::size_t size = data.size() > MADE / 4 ? 0 : data.size();
    if (head_->made_written.load() - head_->made_read.load() + size > MADE / 2 ||
        !put(true, kind, thread, 0, fields.data(), fields.size(), data.data(), size))
      head_->unchecked.fetch_add(1);
  }

  void trigger(std::uint32_t id) {
    head_->trigger.store(id);
    head_->triggered_ns.store(now_ns());
  }

 private:
  bool put(bool is_made, Kind kind, std::uint32_t thread, std::int64_t begun_ns,
           const void *fields, std::size_t fields_size, const void *data, std::size_t data_size) {
    const std::size_t whole = sizeof(RecordHead) + fields_size + data_size;
    const std::size_t size = (whole + 7) / 8 * 8;
    const bool keeps_last = settings().keeps_last;
    auto *ring = reinterpret_cast<std::uint8_t *>(head_) + HEAD + (is_made ? head_->capacity : 0);
    const std::size_t capacity = is_made ? MADE : head_->capacity;
    auto &written = is_made ? head_->made_written : head_->written;
    const auto &read = is_made ? head_->made_read : head_->read;
    const std::uint64_t at = written.load(std::memory_order_relaxed);
    if (!keeps_last || is_made) {
      if (at + size - read.load() > capacity) return false;
    } else {
      head_->reserved.store(at + size);
      const std::size_t part = at / (capacity / PARTS) % PARTS;
      if (part != part_) head_->starts[part].store(at);
      part_ = part;
    }
    const std::int64_t steady_ns = now_ns(), wall_ns = now_ns(CLOCK_REALTIME);
    const std::int64_t spent_ns = begun_ns == 0 ? 0 : steady_ns - begun_ns;
    const RecordHead record{static_cast<std::uint32_t>(whole), kind, steady_ns, wall_ns, thread,
                            static_cast<std::uint32_t>(spent_ns)};
    std::uint64_t next = at;
    const auto copy = [&](const void *from, std::size_t count) {
      const std::size_t place = next % capacity, first = std::min(count, capacity - place);
      std::memcpy(ring + place, from, first);
      std::memcpy(ring, static_cast<const std::uint8_t *>(from) + first, count - first);
      next += count;
    };
    copy(&record, sizeof record);
    copy(fields, fields_size);
    if (data_size > 0) copy(data, data_size);
    written.store(at + size, std::memory_order_release);
    return true;
  }

  Head *head_ = nullptr;
  std::mutex lock_;
  std::uint64_t lost_ = 0;  // since the last record that had room
  std::size_t part_ = PARTS;
};

// Made with the first node, and never destroyed: what runs at the process's end may still send.
Ring &ring() {
  static auto *made = new Ring;
  return *made;
}

void add(Kind kind, const Fields &fields, std::int64_t begun_ns = 0, const Data *data = nullptr) {
  if (data == nullptr) return ring().add(kind, fields.data(), fields.size(), begun_ns);
  ring().add(kind, fields.data(), fields.size(), begun_ns, data->data(), data->size());
}

void add(Kind kind, const Writer &body) {
  ring().add(kind, body.bytes.data(), body.bytes.size(), 0);
}

// -- what there is ------------------------------------------------------------------------------

struct Entity {
  std::uint32_t id = 0;
  bool has_type = false;
  bool keeps_data = true;
  bool is_trigger = false;
  bool is_checked = false;
  MessageCodec type;        // of a topic, or of requests
  MessageCodec other_type;  // of responses
  std::recursive_mutex publishing;  // threads that share a publisher: it counts as the middleware
  std::int64_t sent = 0;
};

using Found = std::shared_ptr<Entity>;

std::shared_mutex &entities_lock() {
  static auto *made = new std::shared_mutex;
  return *made;
}

// By the addresses of handles, of rclcpp's subscriptions and of callbacks.
std::unordered_map<const void *, Found> &entities() {
  static auto *made = new std::unordered_map<const void *, Found>;
  return *made;
}

Found find(const void *handle) {
  if (!ring().is_open()) return nullptr;
  const std::shared_lock<std::shared_mutex> lock(entities_lock());
  const auto found = entities().find(handle);
  return found == entities().end() ? nullptr : found->second;
}

void remember(const void *handle, const Found &entity) {
  const std::lock_guard<std::shared_mutex> lock(entities_lock());
  entities()[handle] = entity;
}

Found new_entity(const void *handle, const char *name = nullptr) {
  static std::atomic<std::uint32_t> last{0};
  auto made = std::make_shared<Entity>();
  made->id = ++last;
  if (name != nullptr) {
    made->keeps_data = settings().has('+', name) && !settings().has('-', name);
    made->is_trigger = settings().has('!', name);
    made->is_checked = settings().keeps_last && settings().has('?', name);
  }
  remember(handle, made);
  return made;
}

std::uint32_t id_of(const void *handle) {
  const Found found = find(handle);
  return found == nullptr ? 0 : found->id;
}

// Note an endpoint. Without a type that can be written as bytes there are no contents.
void made(Kind kind, const void *node, const char *name, const std::string &type,
          const rmw_qos_profile_t &qos, const Found &entity, const std::uint8_t *gid = nullptr) {
  const std::uint8_t none[RMW_GID_STORAGE_SIZE] = {};
  Writer body;
  body.number(entity->id);
  body.number(id_of(node));
  body.text(name);
  body.text(type);
  write_qos(body, qos);
  body.raw(gid == nullptr ? none : gid, RMW_GID_STORAGE_SIZE);
  add(kind, body);
}

Found topic_end(const void *handle, const rosidl_message_type_support_t *type, const char *name) {
  const Found entity = new_entity(handle, name);
  entity->has_type = entity->type.find(type);
  if (!entity->has_type) rmw_reset_error();
  return entity;
}

template <typename Handle>
Handle *service_end(Kind kind, Handle *handle, const rmw_node_t *node,
                    const rosidl_service_type_support_t *type, const char *name,
                    const rmw_qos_profile_t *qos) {
  if (handle == nullptr || !ring().is_open()) return handle;
  const Found entity = new_entity(handle, name);
  rsltrace::ServiceCodec codec;
  entity->has_type = codec.find(type);
  if (!entity->has_type) rmw_reset_error();
  entity->type = codec.request;
  entity->other_type = codec.response;
  made(kind, node, name, codec.name, *qos, entity);
  return handle;
}

// The buffer is this thread's, for one message at a time.
const Data &bytes_of(const Entity &entity, const MessageCodec &type, const void *message) {
  static thread_local Data data;
  data.clear();
  if (entity.has_type && !type.serialize(message, data)) {
    rmw_reset_error();
    data.clear();
  }
  return data;
}

// What the user's bytes are, canonical or not, is for the run to see.
Data bytes_of(const rmw_serialized_message_t &message) {
  return {message.buffer, message.buffer + message.buffer_length};
}

void add_message(Kind kind, Fields &fields, const Entity &entity, const Data &data, bool is_raw,
                 std::int64_t begun_ns) {
  // What is taken has been sent, with its bytes; the user's may have others.
  const bool has_data = (is_raw || (kind == Kind::SENDING && entity.keeps_data)) &&
                        data.size() <= settings().largest;
  fields.number(static_cast<std::uint32_t>(is_raw && has_data));
  fields.number(data.empty() ? UINT64_C(0) : rsltrace::hash64(data.data(), data.size()));
  if (entity.is_checked && kind == Kind::SENDING) ring().show(kind, fields, data);
  add(kind, fields, begun_ns, has_data ? &data : nullptr);
  if (entity.is_trigger) ring().trigger(entity.id);
}

// -- what happens -------------------------------------------------------------------------------

enum class Sent : std::uint32_t { MESSAGE, REQUEST, RESPONSE };

// Note before it that something is sent, and afterwards whether it was: whoever gets it may be faster
// than that. `number` is that of the message, of a request once it is known.
template <typename Send>
rmw_ret_t send(Sent kind, const Found &from, const Data &data, bool is_raw, std::int64_t begun_ns,
               const std::int64_t *number, Send really) {
  Fields fields;
  fields.number(from->id);
  fields.number(static_cast<std::uint32_t>(kind));
  fields.number(kind == Sent::REQUEST ? INT64_C(0) : *number);
  add_message(Kind::SENDING, fields, *from, data, is_raw, begun_ns);
  const rmw_ret_t status = really();
  Fields end;
  end.number(static_cast<std::uint32_t>(status == RMW_RET_OK));
  end.number(*number);
  add(Kind::SENT, end);
  return status;
}

template <typename Send>
rmw_ret_t publish(const Found &from, const Data &data, bool is_raw, std::int64_t begun_ns,
                  Send really) {
  const std::lock_guard<std::recursive_mutex> lock(from->publishing);
  const std::int64_t number = ++from->sent;
  const rmw_ret_t status = send(Sent::MESSAGE, from, data, is_raw, begun_ns, &number, really);
  if (status != RMW_RET_OK) --from->sent;  // the middleware has not counted it
  return status;
}

void took(const Found &by, std::uint64_t number, std::int64_t source_ns, std::int64_t received_ns,
          const std::uint8_t *gid, const Data &data, bool is_raw, std::int64_t begun_ns) {
  const std::uint8_t none[RMW_GID_STORAGE_SIZE] = {};
  Fields fields;
  fields.number(by->id);
  fields.number(number);
  fields.number(source_ns);
  fields.number(received_ns);
  fields.raw(gid == nullptr ? none : gid, RMW_GID_STORAGE_SIZE);
  add_message(Kind::TAKE, fields, *by, data, is_raw, begun_ns);
}

void took(const Found &by, const rmw_message_info_t &info, const Data &data, bool is_raw,
          std::int64_t begun_ns) {
  took(by, info.publication_sequence_number, info.source_timestamp, info.received_timestamp,
       info.publisher_gid.data, data, is_raw, begun_ns);
}

void took(const Found &by, const rmw_service_info_t &info, const Data &data, std::int64_t begun_ns) {
  took(by, static_cast<std::uint64_t>(info.request_id.sequence_number), info.source_timestamp,
       info.received_timestamp, nullptr, data, false, begun_ns);
}

void bracket(Kind kind, const void *callback) {
  if (!ring().is_open()) return;
  Fields fields;
  fields.number(static_cast<std::uint64_t>(reinterpret_cast<std::uintptr_t>(callback)));
  add(kind, fields);
}

// The callback at an address is an entity's.
void belongs(const void *callback, const Found &entity) {
  if (entity == nullptr) return;
  Fields fields;
  fields.number(static_cast<std::uint64_t>(reinterpret_cast<std::uintptr_t>(callback)));
  fields.number(entity->id);
  add(Kind::CALLBACK, fields);
}

void called(std::uint32_t timer, std::int64_t due_ns) {
  Fields fields;
  fields.number(timer);
  fields.number(due_ns);
  add(Kind::CALL, fields);
}

thread_local bool is_within = false;  // one function of rcl's calls the other

// Note the call of a timer. Its callback runs within it if rcl knows it; in rclcpp it runs after it,
// perhaps in another thread.
template <typename Call>
rcl_ret_t call_timer(const rcl_timer_t *timer, Call really) {
  const Found found = is_within ? nullptr : find(timer);
  if (found == nullptr) return really();
  bool is_canceled = true;
  std::int64_t left_ns = 0;
  if (REAL(rcl_timer_is_canceled)(timer, &is_canceled) != RCL_RET_OK || is_canceled ||
      REAL(rcl_timer_get_time_until_next_call)(timer, &left_ns) != RCL_RET_OK)
    return really();
  const std::int64_t due_ns = now_ns(CLOCK_REALTIME) + std::min<std::int64_t>(left_ns, 0);
  const bool has_callback = REAL(rcl_timer_get_callback)(timer) != nullptr;
  if (has_callback) {
    called(found->id, due_ns);
    bracket(Kind::BEGIN, timer);
  }
  is_within = true;
  const rcl_ret_t status = really();
  is_within = false;
  if (has_callback)
    bracket(Kind::END, timer);
  else if (status == RCL_RET_OK)
    called(found->id, due_ns);
  return status;
}

void named(const void *callback, const char *symbol) {
  if (!ring().is_open() || symbol == nullptr) return;
  Writer body;
  body.number(static_cast<std::uint64_t>(reinterpret_cast<std::uintptr_t>(callback)));
  body.text(symbol);
  add(Kind::NAME, body);
}

}  // namespace

// -- rmw: what is made --------------------------------------------------------------------------

EXPORT rmw_node_t *rmw_create_node(rmw_context_t *context, const char *name, const char *space) {
  rmw_node_t *node = REAL(rmw_create_node)(context, name, space);
  if (node == nullptr || !ring().is_open()) return node;
  Writer body;
  body.number(new_entity(node)->id);
  body.text(name);
  body.text(space);
  add(Kind::NODE, body);
  return node;
}

EXPORT rmw_publisher_t *rmw_create_publisher(const rmw_node_t *node,
                                             const rosidl_message_type_support_t *type,
                                             const char *topic, const rmw_qos_profile_t *qos,
                                             const rmw_publisher_options_t *options) {
  rmw_publisher_t *publisher = REAL(rmw_create_publisher)(node, type, topic, qos, options);
  if (publisher == nullptr || !ring().is_open()) return publisher;
  rmw_gid_t gid{};
  if (REAL(rmw_get_gid_for_publisher)(publisher, &gid) != RMW_RET_OK) rmw_reset_error();
  const Found entity = topic_end(publisher, type, topic);
  made(Kind::PUBLISHER, node, topic, entity->has_type ? entity->type.name() : "", *qos,
       entity, gid.data);
  return publisher;
}

EXPORT rmw_subscription_t *rmw_create_subscription(const rmw_node_t *node,
                                                   const rosidl_message_type_support_t *type,
                                                   const char *topic, const rmw_qos_profile_t *qos,
                                                   const rmw_subscription_options_t *options) {
  rmw_subscription_t *subscription = REAL(rmw_create_subscription)(node, type, topic, qos, options);
  if (subscription == nullptr || !ring().is_open()) return subscription;
  const Found entity = topic_end(subscription, type, topic);
  made(Kind::SUBSCRIPTION, node, topic, entity->has_type ? entity->type.name() : "",
       *qos, entity);
  return subscription;
}

EXPORT rmw_client_t *rmw_create_client(const rmw_node_t *node,
                                       const rosidl_service_type_support_t *type, const char *name,
                                       const rmw_qos_profile_t *qos) {
  return service_end(Kind::CLIENT, REAL(rmw_create_client)(node, type, name, qos), node, type, name,
                     qos);
}

EXPORT rmw_service_t *rmw_create_service(const rmw_node_t *node,
                                         const rosidl_service_type_support_t *type,
                                         const char *name, const rmw_qos_profile_t *qos) {
  return service_end(Kind::SERVICE, REAL(rmw_create_service)(node, type, name, qos), node, type,
                     name, qos);
}

// -- rmw: what is sent --------------------------------------------------------------------------

EXPORT rmw_ret_t rmw_publish(const rmw_publisher_t *publisher, const void *message,
                             rmw_publisher_allocation_t *allocation) {
  const auto really = [&] { return REAL(rmw_publish)(publisher, message, allocation); };
  const std::int64_t begun_ns = now_ns();
  const Found from = find(publisher);
  if (from == nullptr || message == nullptr) return really();
  return publish(from, bytes_of(*from, from->type, message), false, begun_ns, really);
}

EXPORT rmw_ret_t rmw_publish_loaned_message(const rmw_publisher_t *publisher, void *message,
                                            rmw_publisher_allocation_t *allocation) {
  const auto really = [&] { return REAL(rmw_publish_loaned_message)(publisher, message, allocation); };
  const std::int64_t begun_ns = now_ns();
  const Found from = find(publisher);
  if (from == nullptr || message == nullptr) return really();
  return publish(from, bytes_of(*from, from->type, message), false, begun_ns, really);
}

EXPORT rmw_ret_t rmw_publish_serialized_message(const rmw_publisher_t *publisher,
                                                const rmw_serialized_message_t *message,
                                                rmw_publisher_allocation_t *allocation) {
  const auto really = [&] {
    return REAL(rmw_publish_serialized_message)(publisher, message, allocation);
  };
  const std::int64_t begun_ns = now_ns();
  const Found from = find(publisher);
  if (from == nullptr || message == nullptr) return really();
  return publish(from, bytes_of(*message), true, begun_ns, really);
}

EXPORT rmw_ret_t rmw_send_request(const rmw_client_t *client, const void *request,
                                  int64_t *sequence_id) {
  const auto really = [&] { return REAL(rmw_send_request)(client, request, sequence_id); };
  const std::int64_t begun_ns = now_ns();
  const Found from = find(client);
  if (from == nullptr || request == nullptr || sequence_id == nullptr) return really();
  const Data data = bytes_of(*from, from->type, request);
  return send(Sent::REQUEST, from, data, false, begun_ns, sequence_id, really);
}

EXPORT rmw_ret_t rmw_send_response(const rmw_service_t *service, rmw_request_id_t *header,
                                   void *response) {
  const auto really = [&] { return REAL(rmw_send_response)(service, header, response); };
  const std::int64_t begun_ns = now_ns();
  const Found from = find(service);
  if (from == nullptr || header == nullptr || response == nullptr) return really();
  const Data data = bytes_of(*from, from->other_type, response);
  return send(Sent::RESPONSE, from, data, false, begun_ns, &header->sequence_number, really);
}

// -- rmw: what is taken -------------------------------------------------------------------------

EXPORT rmw_ret_t rmw_take_with_info(const rmw_subscription_t *subscription, void *message,
                                    bool *taken, rmw_message_info_t *info,
                                    rmw_subscription_allocation_t *allocation) {
  const rmw_ret_t status = REAL(rmw_take_with_info)(subscription, message, taken, info, allocation);
  if (status != RMW_RET_OK || !*taken) return status;
  const std::int64_t begun_ns = now_ns();
  if (const Found by = find(subscription))
    took(by, *info, bytes_of(*by, by->type, message), false, begun_ns);
  return status;
}

EXPORT rmw_ret_t rmw_take(const rmw_subscription_t *subscription, void *message, bool *taken,
                          rmw_subscription_allocation_t *allocation) {
  rmw_message_info_t info = rmw_get_zero_initialized_message_info();
  return rmw_take_with_info(subscription, message, taken, &info, allocation);
}

EXPORT rmw_ret_t rmw_take_loaned_message_with_info(const rmw_subscription_t *subscription,
                                                   void **message, bool *taken,
                                                   rmw_message_info_t *info,
                                                   rmw_subscription_allocation_t *allocation) {
  const rmw_ret_t status =
      REAL(rmw_take_loaned_message_with_info)(subscription, message, taken, info, allocation);
  if (status != RMW_RET_OK || !*taken) return status;
  const std::int64_t begun_ns = now_ns();
  if (const Found by = find(subscription))
    took(by, *info, bytes_of(*by, by->type, *message), false, begun_ns);
  return status;
}

EXPORT rmw_ret_t rmw_take_serialized_message_with_info(const rmw_subscription_t *subscription,
                                                       rmw_serialized_message_t *message,
                                                       bool *taken, rmw_message_info_t *info,
                                                       rmw_subscription_allocation_t *allocation) {
  const rmw_ret_t status =
      REAL(rmw_take_serialized_message_with_info)(subscription, message, taken, info, allocation);
  if (status != RMW_RET_OK || !*taken) return status;
  const std::int64_t begun_ns = now_ns();
  if (const Found by = find(subscription)) took(by, *info, bytes_of(*message), true, begun_ns);
  return status;
}

EXPORT rmw_ret_t rmw_take_sequence(const rmw_subscription_t *subscription, size_t count,
                                   rmw_message_sequence_t *messages,
                                   rmw_message_info_sequence_t *infos, size_t *taken,
                                   rmw_subscription_allocation_t *allocation) {
  const rmw_ret_t status =
      REAL(rmw_take_sequence)(subscription, count, messages, infos, taken, allocation);
  const Found by = status == RMW_RET_OK ? find(subscription) : nullptr;
  for (std::size_t i = 0; by != nullptr && i < *taken; ++i) {
    const std::int64_t begun_ns = now_ns();
    took(by, infos->data[i], bytes_of(*by, by->type, messages->data[i]), false, begun_ns);
  }
  return status;
}

EXPORT rmw_ret_t rmw_take_request(const rmw_service_t *service, rmw_service_info_t *info,
                                  void *request, bool *taken) {
  const rmw_ret_t status = REAL(rmw_take_request)(service, info, request, taken);
  if (status != RMW_RET_OK || !*taken) return status;
  const std::int64_t begun_ns = now_ns();
  if (const Found by = find(service)) took(by, *info, bytes_of(*by, by->type, request), begun_ns);
  return status;
}

EXPORT rmw_ret_t rmw_take_response(const rmw_client_t *client, rmw_service_info_t *info,
                                   void *response, bool *taken) {
  const rmw_ret_t status = REAL(rmw_take_response)(client, info, response, taken);
  if (status != RMW_RET_OK || !*taken) return status;
  const std::int64_t begun_ns = now_ns();
  if (const Found by = find(client))
    took(by, *info, bytes_of(*by, by->other_type, response), begun_ns);
  return status;
}

EXPORT rmw_ret_t rmw_wait(rmw_subscriptions_t *subscriptions, rmw_guard_conditions_t *guards,
                          rmw_services_t *services, rmw_clients_t *clients, rmw_events_t *events,
                          rmw_wait_set_t *set, const rmw_time_t *timeout) {
  if (is_active && ring().is_open()) add(Kind::WAIT, Fields());
  return REAL(rmw_wait)(subscriptions, guards, services, clients, events, set, timeout);
}

// -- rcl: timers --------------------------------------------------------------------------------

EXPORT rcl_ret_t rcl_timer_init2(rcl_timer_t *timer, rcl_clock_t *clock, rcl_context_t *context,
                                 int64_t period, const rcl_timer_callback_t callback,
                                 rcl_allocator_t allocator, bool autostart) {
  const rcl_ret_t status =
      REAL(rcl_timer_init2)(timer, clock, context, period, callback, allocator, autostart);
  if (status != RCL_RET_OK || !ring().is_open()) return status;
  const Found entity = new_entity(timer);
  Writer body;
  body.number(entity->id);
  body.number(period);
  add(Kind::TIMER, body);
  if (callback != nullptr) belongs(timer, entity);
  return status;
}

EXPORT rcl_ret_t rcl_timer_init(rcl_timer_t *timer, rcl_clock_t *clock, rcl_context_t *context,
                                int64_t period, const rcl_timer_callback_t callback,
                                rcl_allocator_t allocator) {
  return rcl_timer_init2(timer, clock, context, period, callback, allocator, true);
}

EXPORT rcl_ret_t rcl_timer_call(rcl_timer_t *timer) {
  return call_timer(timer, [=] { return REAL(rcl_timer_call)(timer); });
}

EXPORT rcl_ret_t rcl_timer_call_with_info(rcl_timer_t *timer, rcl_timer_call_info_t *info) {
  return call_timer(timer, [=] { return REAL(rcl_timer_call_with_info)(timer, info); });
}

// -- tracetools: callbacks of rclcpp, their names and whose they are ----------------------------

EXPORT void ros_trace_callback_start(const void *callback, const bool is_intra_process) {
  bracket(Kind::BEGIN, callback);
  REAL(ros_trace_callback_start)(callback, is_intra_process);
}

EXPORT void ros_trace_callback_end(const void *callback) {
  bracket(Kind::END, callback);
  REAL(ros_trace_callback_end)(callback);
}

EXPORT void ros_trace_rclcpp_timer_callback_added(const void *timer, const void *callback) {
  belongs(callback, find(timer));
  REAL(ros_trace_rclcpp_timer_callback_added)(timer, callback);
}

EXPORT void ros_trace_rclcpp_timer_link_node(const void *timer, const void *node) {
  REAL(ros_trace_rclcpp_timer_link_node)(timer, node);
  const rmw_node_t *found =
      REAL(rcl_node_get_rmw_handle)(static_cast<const rcl_node_t *>(node));
  if (const Found entity = find(timer)) {
    Writer body;
    body.number(entity->id);
    body.number(id_of(found));
    add(Kind::TIMER_OF, body);
  }
}

EXPORT void ros_trace_rclcpp_subscription_init(const void *handle, const void *subscription) {
  REAL(ros_trace_rclcpp_subscription_init)(handle, subscription);
  const rmw_subscription_t *found =
      REAL(rcl_subscription_get_rmw_handle)(static_cast<const rcl_subscription_t *>(handle));
  if (const Found entity = find(found)) remember(subscription, entity);
}

EXPORT void ros_trace_rclcpp_subscription_callback_added(const void *subscription,
                                                         const void *callback) {
  belongs(callback, find(subscription));
  REAL(ros_trace_rclcpp_subscription_callback_added)(subscription, callback);
}

EXPORT void ros_trace_rclcpp_service_callback_added(const void *handle, const void *callback) {
  const rmw_service_t *found =
      REAL(rcl_service_get_rmw_handle)(static_cast<const rcl_service_t *>(handle));
  belongs(callback, find(found));
  REAL(ros_trace_rclcpp_service_callback_added)(handle, callback);
}

// rclcpp makes the text only if it is wanted.
EXPORT bool ros_trace_enabled_rclcpp_callback_register() { return true; }

EXPORT void ros_trace_do_rclcpp_callback_register(const void *callback, const char *symbol) {
  named(callback, symbol);
  REAL(ros_trace_do_rclcpp_callback_register)(callback, symbol);
}

EXPORT void ros_trace_rclcpp_callback_register(const void *callback, const char *symbol) {
  named(callback, symbol);
  REAL(ros_trace_rclcpp_callback_register)(callback, symbol);
}
