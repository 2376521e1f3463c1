/* The least that answers a KUKA RSI controller: the peer of `tools/bench.py rsi`.
 *
 *     bench_rsi_responder PORT
 *
 * Prints 1 where it may run under SCHED_FIFO, else 0, and answers until it is killed.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <netinet/in.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>

int main(int count, char **arguments)
{
    if (count != 2)
        return 2;
    struct sched_param priority = {.sched_priority = 20};
    int realtime = sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    mlockall(MCL_CURRENT | MCL_FUTURE);

    int link = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((unsigned short)atoi(arguments[1]))};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (link < 0 || bind(link, (struct sockaddr *)&here, sizeof here) != 0)
        return 1;
    printf("%d\n", realtime);
    fflush(stdout);

    char packet[4096], answer[4096];
    for (;;) {
        struct sockaddr_in there;
        socklen_t length = sizeof there;
        ssize_t size = recvfrom(link, packet, sizeof packet - 1, 0, (struct sockaddr *)&there, &length);
        if (size < 0)
            return 1;
        packet[size] = 0;
        const char *ipoc = strstr(packet, "<IPOC>");
        if (ipoc == NULL)
            continue;
        int written = snprintf(
            answer, sizeof answer,
            "<Sen Type=\"ImFree\"><EStr></EStr><AKorr A1=\"%.6f\" A2=\"%.6f\" A3=\"%.6f\" A4=\"%.6f\" A5=\"%.6f\" "
            "A6=\"%.6f\"/><IPOC>%lu</IPOC></Sen>",
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, strtoul(ipoc + 6, NULL, 10));
        sendto(link, answer, (size_t)written, 0, (struct sockaddr *)&there, length);
    }
}
