// Preloaded into a program, makes the disk full: after FULL_DISK_BYTES bytes in files, write() fails with ENOSPC.
#include <dlfcn.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdlib>

extern "C" ssize_t write(int file, const void* data, size_t size) {
	static const auto real = reinterpret_cast<ssize_t (*)(int, const void*, size_t)>(dlsym(RTLD_NEXT, "write"));
	static std::atomic<long> left{std::atol(std::getenv("FULL_DISK_BYTES"))};
	struct stat status {};
	if (fstat(file, &status) == 0 && S_ISREG(status.st_mode) && (left -= static_cast<long>(size)) < 0) {
		errno = ENOSPC;
		return -1;
	}
	return real(file, data, size);
}
