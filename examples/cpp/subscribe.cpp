// The contacts of a skin, in C++: written from protocol/WIRE.md, with nothing of eitskin's code.
//
//   g++ -std=c++17 -O2 -Wall -Wextra -Werror -DMSGPACK_NO_BOOST examples/cpp/subscribe.cpp -lzmq -o subscribe
//   ./subscribe palm          (Debian: g++ cppzmq-dev libmsgpack-cxx-dev)
//
// Usage: subscribe SKIN [FRAMES [SILENCE_S [ENDPOINT]]]. Prints each new frame and its contacts, until FRAMES came.
// Exit status: 0 all came, 1 no fresh frame for SILENCE_S (stop the robot), 2 wrong arguments, no such socket, or a
// folder that is not ours.

#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>

namespace {

using Map = std::map<std::string, msgpack::object>;

constexpr int kSchema = 3;  // and all before it
constexpr double kSilenceS = 0.25;  // five frames of the demo

struct NoFrame : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct NoFolder : std::runtime_error {
  using std::runtime_error::runtime_error;
};

[[gnu::format(printf, 1, 2)]] std::string text(const char* form, ...) {
  char line[256];
  va_list values;
  va_start(values, form);
  std::vsnprintf(line, sizeof line, form, values);
  va_end(values);
  return line;
}

std::string runtime_folder() {
  if (const char* folder = std::getenv("EITSKIN_RUNTIME"); folder && *folder) return folder;
  if (const char* folder = std::getenv("XDG_RUNTIME_DIR"); folder && *folder) return std::string(folder) + "/eitskin";
  return "/tmp/eitskin-" + std::to_string(geteuid());
}

// The publisher's address. Whoever owns the folder can put forged contacts into it: it must be ours alone. Made where
// it is not there yet, so that nobody else makes it while we wait for the service.
std::string endpoint() {
  std::string folder = runtime_folder();
  while (folder.size() > 1 && folder.back() == '/') folder.pop_back();  // lstat would look behind a link
  struct stat found {};
  if ((mkdir(folder.c_str(), 0700) != 0 && errno != EEXIST) || lstat(folder.c_str(), &found) != 0)
    throw NoFolder("runtime folder " + folder + ": " + std::strerror(errno) +
                   "; expected a folder of your own: start the service, or set EITSKIN_RUNTIME");
  if (!S_ISDIR(found.st_mode) || found.st_uid != geteuid() || (found.st_mode & 077) != 0)
    throw NoFolder("runtime folder " + folder + text(": found user %u, mode %o", found.st_uid, found.st_mode) +
                   text("; expected user %u, mode 40700: set EITSKIN_RUNTIME to your own", geteuid()));
  return "ipc://" + folder + "/publisher.ipc";
}

// The boot id, which says whose monotonic clock the stamps are of.
std::string this_host() {
  std::string id, plain;
  std::ifstream("/proc/sys/kernel/random/boot_id") >> id;
  for (char c : id)
    if (c != '-') plain += c;
  return plain;
}

std::int64_t monotonic_ns() {
  timespec now{};
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1'000'000'000LL + now.tv_nsec;
}

const msgpack::object& field(const Map& map, const char* key) {
  const auto found = map.find(key);
  if (found == map.end()) throw NoFrame(std::string("no field ") + key);
  return found->second;
}

// Whether the frame may still be acted on: `valid_for_s` after its `sample` stamp, when the skin was measured (after
// `read` where it is replayed). Another host's stamps say nothing about our clock; its frames were waited for, and have
// just come, after what their own stamps say that it took.
bool is_fresh(const Map& frame, bool replay) {
  static const std::string host = this_host();
  const auto stamps = field(frame, "stamps").as<std::map<std::string, std::int64_t>>();
  const auto sample = stamps.find(replay ? "read" : "sample");
  if (sample == stamps.end()) return false;
  std::int64_t now = monotonic_ns();
  if (field(frame, "host").as<std::string>() != host) {
    now = sample->second;
    for (const auto& stamp : stamps) now = std::max(now, stamp.second);
  }
  return 1e-9 * static_cast<double>(now - sample->second) <= field(frame, "valid_for_s").as<double>();
}

std::string describe(const Map& contact) {
  const auto position = field(contact, "position").as<std::vector<double>>();
  if (position.size() != 3) throw NoFrame("a position is three numbers");
  std::string line = text("  contact %llu %s at %+.6f %+.6f %+.6f m", field(contact, "id").as<unsigned long long>(),
                          field(contact, "state").as<std::string>().c_str(), position[0], position[1], position[2]);
  const auto& force = field(contact, "force_n");
  if (force.is_nil()) return line + " force unknown\n";  // a skin that nobody calibrated
  line += text(" force %.6f", force.as<double>());
  const auto& sigma = field(contact, "force_sigma_n");
  return line + (sigma.is_nil() ? " N\n" : text(" +- %.6f N\n", sigma.as<double>()));
}

// Prints a message's frame and its contacts; whether they are fresh. Throws for what is no frame.
bool print(const std::string& message) {
  const auto body = message.find('\0');
  if (body == std::string::npos) throw NoFrame("no topic");
  const auto unpacked = msgpack::unpack(message.data() + body + 1, message.size() - body - 1);
  const auto frame = unpacked.get().as<Map>();
  if (field(frame, "schema").as<int>() > kSchema) throw NoFrame("of a newer schema than this program knows");
  const bool replay = field(frame, "source").as<std::string>() == "replay", fresh = is_fresh(frame, replay);
  const bool valid = field(frame, "valid").as<bool>();
  std::string out = text("frame %llu ", field(frame, "seq").as<unsigned long long>());
  out += !fresh ? "STALE" : replay ? "REPLAY" : valid ? "valid" : "INVALID";
  for (const auto& reason : field(frame, "reasons").as<std::vector<std::string>>()) out += " " + reason;
  out += "\n";
  for (const auto& contact : field(frame, "contacts").as<std::vector<Map>>())
    if (field(contact, "state").as<std::string>() != "end") out += describe(contact);  // else it has gone
  std::fputs(out.c_str(), stdout);
  std::fflush(stdout);
  return fresh;
}

int subscribe(const std::string& skin, long frames, double silence_s, const std::string& address) {
  zmq::context_t context;
  zmq::socket_t socket(context, zmq::socket_type::sub);
  socket.set(zmq::sockopt::linger, 0);
  socket.set(zmq::sockopt::conflate, true);  // the newest frame only; before connect
  socket.set(zmq::sockopt::subscribe, "contact/" + skin + std::string(1, '\0'));
  socket.connect(address);  // a service that comes later, or back, is found by itself
  zmq::pollitem_t waiting[] = {{socket.handle(), 0, ZMQ_POLLIN, 0}};
  auto last = monotonic_ns();
  for (long seen = 0; frames < 0 || seen < frames;) {
    zmq::poll(waiting, 1, std::chrono::milliseconds(50));
    zmq::message_t message;
    if (socket.recv(message, zmq::recv_flags::dontwait)) {
      try {
        if (print(message.to_string())) {
          last = monotonic_ns();
          ++seen;
        }
      } catch (const std::exception& bad) {  // anything may arrive: dropped, and never a reason to stop
        std::fprintf(stderr, "dropped what is no frame: %s\n", bad.what());
      }
    }
    if (1e-9 * static_cast<double>(monotonic_ns() - last) > silence_s) {
      std::fprintf(stderr, "no fresh contact frame of %s for %g s at %s: is the service running?\n", skin.c_str(),
                   silence_s, address.c_str());
      return 1;
    }
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2 || argc > 5) {
    std::fprintf(stderr, "usage: %s SKIN [FRAMES [SILENCE_S [ENDPOINT]]]\n", argv[0]);
    return 2;
  }
  try {
    return subscribe(argv[1], argc > 2 ? std::atol(argv[2]) : -1, argc > 3 ? std::atof(argv[3]) : kSilenceS,
                     argc > 4 ? argv[4] : endpoint());
  } catch (const NoFolder& bad) {
    std::fprintf(stderr, "%s\n", bad.what());
    return 2;
  } catch (const zmq::error_t& bad) {
    std::fprintf(stderr, "cannot subscribe: %s; expected ipc://PATH or tcp://HOST:PORT\n", bad.what());
    return 2;
  }
}
