/* Preloaded into a service: steps its wall clock and delays its syncs, as two shared numbers say.
   Usage: LD_PRELOAD=chaos_preload.so CHAOS_FILE=FILE; FILE has two int64: offset of the wall clock (ns), delay (ms). */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t zero[2];
static volatile int64_t *shared = zero;
static int (*real_gettime)(clockid_t, struct timespec *);
static int (*real_fsync)(int);
static int (*real_fdatasync)(int);

__attribute__((constructor)) static void load(void) {
    real_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    real_fsync = dlsym(RTLD_NEXT, "fsync");
    real_fdatasync = dlsym(RTLD_NEXT, "fdatasync");
    const char *path = getenv("CHAOS_FILE");
    int file = path ? open(path, O_RDONLY) : -1;
    if (file < 0) return;
    void *mapped = mmap(NULL, 16, PROT_READ, MAP_SHARED, file, 0);
    if (mapped != MAP_FAILED) shared = mapped;
    close(file);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    int result = real_gettime(clock, time);
    if (result == 0 && clock == CLOCK_REALTIME) {
        int64_t ns = time->tv_nsec + shared[0] % 1000000000;
        time->tv_sec += shared[0] / 1000000000 + (ns >= 1000000000) - (ns < 0);
        time->tv_nsec = ns >= 1000000000 ? ns - 1000000000 : ns < 0 ? ns + 1000000000 : ns;
    }
    return result;
}

static void delay(void) {
    int64_t ms = shared[1];
    struct timespec time = {ms / 1000, ms % 1000 * 1000000};
    if (ms > 0) nanosleep(&time, NULL);
}

int fsync(int file) { delay(); return real_fsync(file); }
int fdatasync(int file) { delay(); return real_fdatasync(file); }
