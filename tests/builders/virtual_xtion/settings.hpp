// What the tests ask of the virtual cameras: the environment, read once, and a control file, polled while it runs.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <mutex>
#include <set>
#include <sstream>
#include <string>
#include <vector>

namespace vxtion {

constexpr int kMaxDevices = 16;
constexpr double kPeriodUs = 1e6 / 30;

enum Kind { kColor = 0, kDepth = 1 };

inline std::string text(const char* name) {
	const char* value = std::getenv(name);
	return value ? value : "";
}

inline long number(const char* name, long otherwise) {
	const std::string value = text(name);
	return value.empty() ? otherwise : std::atol(value.c_str());
}

// "10,20,30" gives one value a device; the last one holds for the rest.
inline long numberOf(const char* name, int device, long otherwise) {
	std::stringstream list(text(name));
	std::string item;
	long value = otherwise;
	for (int i = 0; i <= device && std::getline(list, item, ','); ++i) value = std::atol(item.c_str());
	return value;
}

// "1,3" names devices.
inline bool listed(const char* name, int device) {
	std::stringstream list(text(name));
	for (std::string item; std::getline(list, item, ',');)
		if (std::atoi(item.c_str()) == device) return true;
	return false;
}

inline std::vector<std::string> words(const std::string& list) {
	std::vector<std::string> out;
	std::stringstream stream(list);
	for (std::string item; std::getline(stream, item, ',');) out.push_back(item);
	return out;
}

struct DeviceFaults {
	std::array<std::atomic<bool>, 2> stalled{};
	std::array<std::atomic<int>, 2> drop{};
	std::atomic<bool> plugged{true}, hasDepth{true};
};

// The state of the world that all devices share.
struct World {
	int devices = static_cast<int>(number("VXTION_DEVICES", 1));
	std::string data = text("VXTION_DATA");
	std::string control = text("VXTION_CONTROL");
	bool stamp = number("VXTION_STAMP", 0) != 0;
	// How many periods each picture of the data stays in view; 0: one exposure each, counted by each device.
	long hold = number("VXTION_HOLD", 0);
	bool autoExposureShows = number("VXTION_AE_SHOWS", 0) != 0;
	bool interference = number("VXTION_INTERFERENCE", 0) != 0;
	// Which picture of the data is in view; -1: they follow each other.
	std::atomic<long> scene{number("VXTION_SCENE", -1)};
	// No frames of its own: the program that loaded the driver sends each of them; see the end of virtual_xtion.cpp.
	bool byHand = number("VXTION_BY_HAND", 0) != 0;
	std::vector<std::string> serials = words(text("VXTION_SERIALS"));
	std::array<DeviceFaults, kMaxDevices> faults;
	std::array<std::atomic<bool>, kMaxDevices> emitter;
	// Kept by the camera from session to session; on when it gets power, as PS1080.
	std::array<std::atomic<bool>, kMaxDevices> autoExposure, autoWhite;
	double startedUs = 0;

	World() {
		for (auto* switches : {&emitter, &autoExposure, &autoWhite})
			for (auto& on : *switches) on = true;
		for (int i = 0; i < devices; ++i) {
			if (listed("VXTION_SILENT", i)) faults[i].stalled[kColor] = faults[i].stalled[kDepth] = true;
			if (listed("VXTION_UNPLUGGED", i)) faults[i].plugged = false;
			if (listed("VXTION_NODEPTH", i)) faults[i].hasDepth = false;
		}
	}

	void log(const std::string& line) {
		const std::string path = text("VXTION_LOG");
		if (path.empty()) return;
		std::lock_guard<std::mutex> lock(logMutex_);
		std::ofstream(path, std::ios::app) << line << "\n";
	}

private:
	std::mutex logMutex_;
};

inline World& world() {
	static World instance;
	return instance;
}

// Lines appended to the control file since the last call.
class ControlFile {
public:
	std::vector<std::string> newLines() {
		std::vector<std::string> lines;
		if (world().control.empty()) return lines;
		std::ifstream stream(world().control);
		stream.seekg(offset_);
		for (std::string line; std::getline(stream, line) && !stream.eof();) {
			offset_ += static_cast<std::streamoff>(line.size()) + 1;
			lines.push_back(line);
		}
		return lines;
	}

private:
	std::streamoff offset_ = 0;
};

inline std::vector<Kind> kinds(const std::string& name) {
	if (name == "color") return {kColor};
	if (name == "depth") return {kDepth};
	return {kColor, kDepth};
}

}  // namespace vxtion
